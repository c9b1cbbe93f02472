"""How a model field is randomized: what is drawn (`Distribution`) and how it is used (`Operation`).

Both are open: an instance of your own passes wherever a name is accepted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

Bounds = tuple[float, float] | list[float]
"""Two numbers: lower and upper bound, or mean and standard deviation for "gaussian"."""

Ranges = Bounds | dict[int, Bounds] | dict[str, "Bounds | dict[int, Bounds]"]
"""Bounds for all target axes, by axis, or by a pattern of object names (with either inside)."""


@dataclass(frozen=True)
class Distribution:
    """A named random distribution with two parameters."""

    name: str
    """Name by which terms refer to it."""
    sample: Callable[[torch.Tensor, torch.Tensor, tuple[int, ...], str], torch.Tensor]
    """Called as `sample(lower, upper, shape, device)` with 0-d tensors; returns `shape`."""
    check: Callable[[float, float], None] | None = None
    """Called with the plain bounds before sampling; raises `ValueError` if they make no sense."""


@dataclass(frozen=True)
class Operation:
    """How samples turn into new values: `new = combine(base, rnd)`.

    `rnd` is `initialize(base)` with the target axes overwritten by samples.
    """

    name: str
    """Name by which terms refer to it."""
    initialize: Callable[[torch.Tensor], torch.Tensor]
    """Returns the neutral element for the base values, of the same shape."""
    combine: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    """Returns the new values from base values and samples."""
    uses_defaults: bool
    """Whether the base is the compile-time default (repeating never accumulates) or the current
    value."""


def _uniform(
    lower: torch.Tensor, upper: torch.Tensor, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    return torch.rand(shape, dtype=torch.float32, device=device) * (upper - lower) + lower


def _log_uniform(
    lower: torch.Tensor, upper: torch.Tensor, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    low, high = torch.log(lower), torch.log(upper)
    drawn = torch.exp(torch.rand(shape, dtype=torch.float32, device=device) * (high - low) + low)
    # Equal bounds are a constant, also at or below zero, where the logarithm does not exist.
    return torch.where(lower == upper, lower.expand(shape), drawn)


def _gaussian(
    lower: torch.Tensor, upper: torch.Tensor, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    return torch.randn(shape, dtype=torch.float32, device=device) * upper + lower


def _check_log_bounds(lower: float, upper: float) -> None:
    if lower != upper and min(lower, upper) <= 0.0:
        raise ValueError(
            f"log_uniform needs bounds above 0 (or equal bounds, which are a constant), "
            f"got ({lower}, {upper}). Use 'uniform' for ranges that touch 0."
        )


def _check_deviation(mean: float, deviation: float) -> None:
    if deviation < 0.0:
        raise ValueError(
            f"gaussian takes (mean, standard deviation); the deviation must not be negative, "
            f"got ({mean}, {deviation})."
        )


UNIFORM = Distribution("uniform", _uniform)
LOG_UNIFORM = Distribution("log_uniform", _log_uniform, _check_log_bounds)
GAUSSIAN = Distribution("gaussian", _gaussian, _check_deviation)

DISTRIBUTIONS = {d.name: d for d in (UNIFORM, LOG_UNIFORM, GAUSSIAN)}

ABS = Operation("abs", torch.clone, lambda base, rnd: rnd, uses_defaults=False)
SCALE = Operation("scale", torch.ones_like, lambda base, rnd: base * rnd, uses_defaults=True)
ADD = Operation("add", torch.zeros_like, lambda base, rnd: base + rnd, uses_defaults=True)

OPERATIONS = {operation.name: operation for operation in (ABS, SCALE, ADD)}

T = TypeVar("T")


def resolve_distribution(dist: Distribution | str) -> Distribution:
    """Return the distribution of that name; an instance passes through.

    Raises `ValueError` for an unknown name.
    """
    return _resolve(dist, Distribution, DISTRIBUTIONS)


def resolve_operation(op: Operation | str) -> Operation:
    """Return the operation of that name; an instance passes through.

    Raises `ValueError` for an unknown name.
    """
    return _resolve(op, Operation, OPERATIONS)


def _resolve(given: T | str, kind: type[T], known: dict[str, T]) -> T:
    if isinstance(given, kind):
        return given
    if not isinstance(given, str) or given not in known:
        raise ValueError(
            f"Unknown {kind.__name__.lower()} {given!r}. Choose one of {sorted(known)}, "
            f"or pass a {kind.__name__} of your own."
        )
    return known[given]


def read_bounds(given: Any, what: str) -> tuple[float, float]:
    """Return two floats from a pair in a tuple or list.

    Raises `ValueError` naming `what` for anything else.
    """
    if isinstance(given, (tuple, list)) and len(given) == 2:
        lower, upper = given
        if all(isinstance(bound, (int, float)) for bound in (lower, upper)):
            return float(lower), float(upper)
    raise ValueError(
        f"{what} must be a pair of numbers, such as (0.8, 1.2), got {given!r} "
        f"of type {type(given).__name__}."
    )


def draw(
    distribution: Distribution, bounds: tuple[float, float], shape: tuple[int, ...], device: str
) -> torch.Tensor:
    """Sample a tensor of `shape`.

    Raises `ValueError` if the distribution does not accept the bounds, or returns another shape.
    """
    if distribution.check is not None:
        distribution.check(*bounds)
    # Filled on the device: copies from the host would wait for it.
    lower, upper = (torch.full((), b, dtype=torch.float32, device=device) for b in bounds)
    sample = distribution.sample(lower, upper, shape, device)
    if sample.shape != torch.Size(shape):
        raise ValueError(
            f"The distribution {distribution.name!r} returned shape {tuple(sample.shape)}; "
            f"it must return the shape it is asked for, {shape}."
        )
    return sample
