"""Ranges beside the fields of configs, and the numbers outside them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction as Ratio
from typing import Annotated

import numpy as np
import pytest
import torch

from mjlab.utils.ranges import (
    Count,
    Fraction,
    Limit,
    Number,
    Positive,
    Range,
    check_ranges,
    out_of_range,
)


@dataclass
class Inner:
    gamma: Fraction = 0.9
    limit: Limit | None = 1.0
    rate: Positive = 1.0
    steps: Count = 1
    goal: Number = 0.0
    widths: Annotated[tuple[int, ...], Range(-1)] = (8,)
    bounds: Annotated[dict[str, float], Range()] = field(default_factory=dict)
    free: float = 0.0


@dataclass
class Outer:
    inner: Inner = field(default_factory=Inner)
    others: dict[str, Inner] = field(default_factory=dict)
    several: list[Inner] = field(default_factory=list)


VALID = {
    "gamma": (0, 1.0, True, np.float32(0.5), Ratio(1, 2), None, "1.5", torch.tensor(1.5)),
    "limit": (None, 1e-9, math.inf),
    "rate": (1e300, 1),
    "steps": (1, True, np.int64(3), 10**400),
    "goal": (-math.inf, math.inf, 0),
    "widths": ((), [8], (-1, 8)),
    "bounds": ({"a": -math.inf}, {"a": "x"}),
    "free": (math.nan, -5),
}
INVALID = {
    "gamma": (1.5, -0.1, math.nan, np.float32(1.5), 10**400),
    "limit": (0, -1.0, math.nan),
    "rate": (0.0, math.inf, math.nan),
    "steps": (0, -1, 2.0, False, np.int64(0)),
    "goal": (math.nan,),
    "widths": ((-2,), (8, -2), (8.0,)),
    "bounds": ({"a": math.nan},),
}


@pytest.mark.parametrize(("name", "value"), [(k, v) for k, each in VALID.items() for v in each])
def test_numbers_in_range_pass(name, value):
    assert not list(out_of_range(Inner(**{name: value})))


@pytest.mark.parametrize(("name", "value"), [(k, v) for k, each in INVALID.items() for v in each])
def test_numbers_out_of_range_are_found(name, value):
    (found,) = out_of_range(Inner(**{name: value}), "inner")
    assert found[0].startswith(f"inner.{name}")


def test_nested_configs_are_searched():
    bad = Inner(gamma=2.0)
    found = out_of_range(Outer(inner=bad, others={"a": bad}, several=[Inner(), bad]))
    assert [path for path, _, _ in found] == ["inner.gamma", "others.a.gamma", "several.1.gamma"]


def test_a_config_may_hold_itself():
    outer = Outer()
    outer.others["self"] = outer  # ty: ignore[invalid-assignment]
    assert not list(out_of_range(outer))


def test_a_redefined_field_keeps_its_range():
    @dataclass
    class Mine(Inner):
        gamma: float = 1.5
        mine: NoSuchName = 0  # noqa: F821  # ty: ignore[unresolved-reference]

    @dataclass
    class Wider(Inner):
        gamma: Annotated[float, Range(0.0, 2.0)] = 1.5

    assert [path for path, _, _ in out_of_range(Mine())] == ["gamma"]
    assert not list(out_of_range(Wider()))


@pytest.mark.parametrize("typed", ["inner.gamma", "inner"])
def test_typed_numbers_raise(typed):
    with pytest.raises(
        ValueError, match=r"^--inner\.gamma: expected a number in \[0, 1\], got 2\.0"
    ):
        check_ranges(Outer(inner=Inner(gamma=2.0)), {typed})


def test_other_numbers_warn():
    with pytest.warns(UserWarning, match="inner") as told:
        check_ranges(Outer(inner=Inner(gamma=2.0, goal=math.nan)), {"inner.rate", "inner.gam"})
    assert [str(one.message).partition(":")[0] for one in told] == ["inner.gamma", "inner.goal"]


def test_flags_of_a_command_raise():
    with pytest.raises(ValueError, match="--steps: expected an integer >= 1, got -1"):
        check_ranges(Inner(steps=-1), {"steps"})


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        (Range(), "a number"),
        (Range(ends="()"), "a finite number"),
        (Range(1), "an integer >= 1"),
        (Range(0.0, ends="()"), "a finite number > 0"),
        (Range(0.0, 0.5, "(]"), "a number in (0, 0.5]"),
        (Range(-1, 2**32 - 1), "an integer in [-1, 4294967295]"),
    ],
)
def test_ranges_read_as_words(limits, text):
    assert str(limits) == text
