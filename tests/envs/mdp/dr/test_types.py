"""Distributions and operations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mjlab.envs.mdp.dr import Distribution, Operation
from mjlab.envs.mdp.dr._types import draw, read_bounds, resolve_distribution, resolve_operation


@given(
    name=st.sampled_from(["uniform", "log_uniform", "gaussian"]),
    shape=st.tuples(st.integers(2, 5), st.integers(2, 5)),
)
def test_every_element_is_drawn_for_itself(name: str, shape: tuple[int, int]) -> None:
    sample = draw(resolve_distribution(name), (0.5, 2.0), shape, "cpu")
    assert sample.shape == shape
    assert len(sample.unique()) == sample.numel()


def test_gaussian_takes_mean_and_deviation() -> None:
    torch.manual_seed(0)
    sample = draw(resolve_distribution("gaussian"), (3.0, 0.5), (20000,), "cpu")
    assert sample.mean() == pytest.approx(3.0, abs=0.02)
    assert sample.std() == pytest.approx(0.5, abs=0.02)


@given(st.floats(-5.0, 5.0, width=32))
def test_equal_log_uniform_bounds_are_a_constant(value: float) -> None:
    sample = draw(resolve_distribution("log_uniform"), (value, value), (3,), "cpu")
    assert torch.equal(sample, torch.full((3,), value))


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (-1.0, 1.0)])
def test_log_uniform_of_bounds_at_zero_warns(bounds: tuple[float, float]) -> None:
    with pytest.warns(UserWarning, match="log_uniform bounds: expected bounds > 0") as caught:
        sample = draw(resolve_distribution("log_uniform"), bounds, (3,), "cpu")
    assert len(caught) == 1
    assert sample.shape == (3,)


def test_gaussian_refuses_a_negative_deviation() -> None:
    with pytest.raises(ValueError, match=r"gaussian bounds: .*\(0\.0, -1\.0\)"):
        draw(resolve_distribution("gaussian"), (0.0, -1.0), (3,), "cpu")


def test_unknown_names_list_the_valid_ones_and_instances_pass() -> None:
    with pytest.raises(ValueError, match=r"Unknown distribution 'normal'.*gaussian.*log_uniform"):
        resolve_distribution("normal")
    with pytest.raises(ValueError, match=r"Unknown operation 'mul'.*abs.*add.*scale"):
        resolve_operation("mul")
    mine = Operation("max", torch.zeros_like, torch.maximum, uses_defaults=True)
    assert resolve_operation(mine) is mine
    ours = Distribution("zero", lambda lower, upper, shape, device: torch.zeros(shape))
    assert resolve_distribution(ours) is ours


def test_samples_broadcast_to_the_shape() -> None:
    scalar = Distribution("scalar", lambda lower, upper, shape, device: lower)
    assert torch.equal(draw(scalar, (3.0, 1.0), (2, 2), "cpu"), torch.full((2, 2), 3.0))


def test_samples_of_another_shape_are_an_error() -> None:
    three = Distribution("three", lambda lower, upper, shape, device: torch.zeros(3))
    with pytest.raises(ValueError, match=r"'three': .*shape \(2, 2\), got \(3,\)"):
        draw(three, (0.0, 1.0), (2, 2), "cpu")


@pytest.mark.parametrize("kind", [int, np.float32, np.int64, torch.tensor])
def test_bounds_of_every_kind_of_number(kind: Any) -> None:
    assert read_bounds([kind(1), kind(2)], "ranges") == (1.0, 2.0)


@pytest.mark.parametrize("value", [1.0, (1.0,), (1.0, 2.0, 3.0), ("1", "2"), None, "12"])
def test_bounds_that_are_no_pair_are_an_error(value: Any) -> None:
    with pytest.raises(ValueError, match="ranges: expected a pair of numbers"):
        read_bounds(value, "ranges")
