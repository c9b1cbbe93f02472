"""Laws of the pseudo-inertia perturbation."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjlab.envs.mdp import dr
from mjlab.envs.mdp.dr.body import (
    Inertial,
    inertial_from_pseudo_inertia,
    pseudo_inertia_matrix,
)
from mjlab.utils.lab_api.math import matrix_from_quat

LAWS = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
# The compiler derives the inertia of these from geoms; the torso has its own.
BODIES = ("torso", "thigh", "shin", "foot")
_WORLDS: dict[str, Any] = {}


def shared_world(make_world: Any) -> Any:
    if not _WORLDS:
        _WORLDS["world"] = make_world()
        _WORLDS["world"].sim.expand_model_fields(FIELDS)
    return _WORLDS["world"]


def inertials(world: Any) -> Inertial:
    return Inertial(*(getattr(world.sim.model, name)[:, 1:].double() for name in FIELDS))


def defaults(world: Any) -> Inertial:
    return Inertial(*(world.sim.get_default_field(name)[1:].double() for name in FIELDS))


def tensor_about_com(body: Inertial) -> torch.Tensor:
    rotation = matrix_from_quat(body.quat)
    return rotation @ torch.diag_embed(body.inertia) @ rotation.transpose(-1, -2)


def test_zero_perturbation_is_the_same_body(make_world: Any) -> None:
    world = make_world()
    world.apply(dr.pseudo_inertia)
    now, before = inertials(world), defaults(world)
    torch.testing.assert_close(now.mass, before.mass.expand(4, 4), rtol=1e-6, atol=0)
    torch.testing.assert_close(now.com, before.com.expand(4, 4, 3), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(
        tensor_about_com(now), tensor_about_com(before).expand(4, 4, 3, 3), rtol=1e-5, atol=1e-7
    )
    assert bool((now.inertia.diff(dim=-1) >= 0.0).all())


@LAWS
@given(
    alpha=st.floats(-1.0, 1.0),
    stretch=st.floats(0.0, 0.8),
    shear=st.floats(0.0, 0.8),
    shift=st.floats(0.0, 0.5),
    distribution=st.sampled_from(["uniform", "gaussian"]),
)
def test_results_are_bodies_that_can_exist(
    make_world: Any, alpha: float, stretch: float, shear: float, shift: float, distribution: str
) -> None:
    world = shared_world(make_world)

    def bounds(size: float) -> tuple[float, float]:
        # Mean and deviation, or lower and upper end.
        return (0.0, size / 3) if distribution == "gaussian" else (-size, size)

    dr.pseudo_inertia(
        world,
        None,
        alpha_range=(alpha, alpha) if distribution == "uniform" else (alpha, 0.0),
        d_range=bounds(stretch),
        s12_range=bounds(shear),
        s13_range=bounds(shear),
        s23_range=bounds(shear),
        t_range=bounds(shift),
        distribution=distribution,
    )
    body = inertials(world)
    torch.testing.assert_close(
        body.mass, torch.exp(torch.tensor(2.0 * alpha)) * defaults(world).mass.expand(4, 4),
        rtol=1e-5, atol=0,
    )  # fmt: skip
    assert bool((body.inertia > 0.0).all())
    # Each principal moment is at most the sum of the other two.
    largest, total = body.inertia.amax(-1), body.inertia.sum(-1)
    assert bool((largest <= (total - largest) * (1.0 + 1e-5)).all())
    eigenvalues = torch.linalg.eigvalsh(pseudo_inertia_matrix(body))
    assert bool((eigenvalues[..., 0] > -1e-6 * eigenvalues[..., -1]).all())
    torch.testing.assert_close(body.quat.norm(dim=-1), torch.ones(4, 4, dtype=torch.double))


@LAWS
@given(shift=st.floats(-0.5, 0.5), stretch=st.floats(-0.5, 0.5))
def test_points_move_by_the_affine_map(make_world: Any, shift: float, stretch: float) -> None:
    world = shared_world(make_world)
    dr.pseudo_inertia(world, None, d1_range=(stretch, stretch), t2_range=(shift, shift))
    expected = defaults(world).com.clone()
    expected[:, 0] *= torch.exp(torch.tensor(stretch))
    expected[:, 1] += shift
    now = inertials(world)
    torch.testing.assert_close(now.com, expected.expand(4, 4, 3), rtol=1e-4, atol=1e-6)
    # The second moment of mass along x, about the center of mass, is stretched twice.
    before, after = tensor_about_com(defaults(world)), tensor_about_com(now)

    def second_moment(inertia: torch.Tensor) -> torch.Tensor:
        trace = inertia.diagonal(dim1=-2, dim2=-1).sum(-1)
        return 0.5 * trace - inertia[..., 0, 0]

    ratio = second_moment(after) / second_moment(before)
    torch.testing.assert_close(
        ratio, torch.full((4, 4), 2.0 * stretch).exp().double(), rtol=1e-3, atol=0
    )


@LAWS
@given(
    mass=st.floats(0.1, 50.0),
    com=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    second=st.tuples(*[st.floats(0.01, 1.0)] * 3),
    quat=st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: sum(x * x for x in q) > 0.1),
)
def test_pseudo_inertia_and_back(
    mass: float,
    com: tuple[float, ...],
    second: tuple[float, ...],
    quat: tuple[float, ...],
) -> None:
    moments = torch.tensor(second, dtype=torch.double)
    rotation = torch.tensor(quat, dtype=torch.double)
    body = Inertial(
        torch.tensor(mass, dtype=torch.double),
        torch.tensor(com, dtype=torch.double),
        moments.sum() - moments,
        rotation / rotation.norm(),
    )
    back = inertial_from_pseudo_inertia(pseudo_inertia_matrix(body))
    torch.testing.assert_close(back.mass, body.mass)
    torch.testing.assert_close(back.com, body.com)
    torch.testing.assert_close(tensor_about_com(back), tensor_about_com(body))


def test_repeating_starts_from_the_default(make_world: Any) -> None:
    world = make_world()
    for _ in range(10):
        world.apply(dr.pseudo_inertia, alpha_range=(0.2, 0.2), t1_range=(0.1, 0.1))
    expected = world.sim.get_default_field("body_mass")[1:] * torch.exp(torch.tensor(0.4))
    torch.testing.assert_close(world.sim.model.body_mass[0, 1:], expected)
    subtree = world.sim.model.body_subtreemass[:, 1]
    torch.testing.assert_close(subtree, world.sim.model.body_mass[:, 1:].sum(dim=1))


def test_log_uniform_works_with_ranges_left_at_zero(make_world: Any) -> None:
    world = make_world()
    world.apply(dr.pseudo_inertia, alpha_range=(0.1, 0.2), distribution="log_uniform")
    factor = world.sim.model.body_mass[:, 1:] / world.sim.get_default_field("body_mass")[1:]
    assert bool(((factor >= 1.22) & (factor <= 1.5)).all())


def test_bodies_without_mass_keep_it(make_cart: Any) -> None:
    # The mocap body above a fixed base has no mass.
    world = make_cart()
    with pytest.warns(UserWarning, match=r"\['mocap_base'\] have no mass") as caught:
        world.apply(dr.pseudo_inertia, alpha_range=(0.1, 0.1))
    assert len(caught) == 1
    factor = math.exp(0.2)
    expected = torch.tensor([0.0, 0.0, 1.0 * factor, 0.1 * factor]).expand(4, 4)
    torch.testing.assert_close(world.sim.model.body_mass, expected)


def test_bodies_without_thickness_keep_their_inertia(make_world: Any) -> None:
    xml = """<mujoco><worldbody><body name="plate"><freejoint/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 2"/></body></worldbody></mujoco>"""
    world = make_world(xml)
    with pytest.warns(UserWarning, match=r"\['plate'\].*not positive definite"):
        world.apply(dr.pseudo_inertia, alpha_range=(0.1, 0.1))
    assert world.sim.model.body_mass[:, 1].tolist() == [1.0] * 4
