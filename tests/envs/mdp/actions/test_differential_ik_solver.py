"""The regularized least-squares problem of inverse kinematics, against the textbook formula."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.envs.mdp.actions.differential_ik import damped_least_squares


def problem(seed: int, rows: int, unknowns: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(5, *shape, generator=generator)

    return draw(rows, unknowns), draw(rows), draw(unknowns).square() + 1e-3, draw(unknowns)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), rows=st.integers(1, 6), unknowns=st.integers(1, 8))
def test_it_solves_the_normal_equations(seed: int, rows: int, unknowns: int) -> None:
    j, e, d, b = problem(seed, rows, unknowns)
    j64, e64, d64, b64 = (x.double() for x in (j, e, d, b))
    normal = j64.mT @ j64 + torch.diag_embed(d64)
    expected = torch.linalg.solve(normal, (j64.mT @ e64[..., None]).squeeze(-1) + b64)
    torch.testing.assert_close(
        damped_least_squares(j, e, d, b), expected.float(), atol=1e-5, rtol=1e-4
    )


@pytest.mark.parametrize("damping", [1e-2, 1e-4, 1e-6])
def test_a_small_damping_loses_no_precision(damping: float) -> None:
    j, e, _, _ = problem(0, 3, 6)
    x = damped_least_squares(j, e, torch.full((5, 6), damping**2), torch.zeros(5, 6))
    # With damping near 0 it is the shortest step that meets the task.
    expected = (torch.linalg.pinv(j.double()) @ e.double()[..., None]).squeeze(-1)
    atol = 3 * damping**2 + 1e-5
    torch.testing.assert_close(x, expected.float(), atol=atol, rtol=1e-4)


def test_a_jacobian_of_zeros_gives_a_finite_step() -> None:
    _, e, _, b = problem(0, 6, 4)
    stiffness = torch.full((5, 4), 1e-12)
    x = damped_least_squares(torch.zeros(5, 6, 4), e, stiffness, 1e-12 * b)
    torch.testing.assert_close(x, b)
