"""Distributions of samples, and operations that combine samples with field values.

Custom instances are accepted wherever a name is.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

from mjlab.utils.lab_api.math import sample_log_uniform, sample_uniform

Bounds = tuple[float, float] | list[float]
"""Two numbers: lower and upper bound, or mean and standard deviation for "gaussian"."""

FieldRanges = Bounds | dict[int, Bounds] | dict[str, "Bounds | dict[int, Bounds]"]
"""Bounds for all target axes, by axis, or by a pattern of object names (with either inside)."""


@dataclass(frozen=True)
class Distribution:
    """Named random distribution with two parameters."""

    name: str
    """Name used in term configs."""
    sample: Callable[[torch.Tensor, torch.Tensor, tuple[int, ...], str], torch.Tensor]
    """Sampler `sample(lower, upper, shape, device)`; bounds are 0-d tensors; returns `shape`."""
    check: Callable[[float, float], None] | None = None
    """Check of the bounds before sampling; warns of invalid bounds, or raises `ValueError`."""


@dataclass(frozen=True)
class Operation:
    """Named operation that computes new values: `new = combine(base, rnd)`.

    `rnd` is `initialize(base)` with the target axes overwritten by samples.
    """

    name: str
    """Name used in term configs."""
    initialize: Callable[[torch.Tensor], torch.Tensor]
    """Function from base values to their neutral element, of the same shape."""
    combine: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    """Function from base values and samples to new values."""
    uses_defaults: bool
    """Use the compile-time default as base, so that repetitions do not accumulate. False: the
    current value."""


def _log_uniform(
    lower: torch.Tensor, upper: torch.Tensor, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    samples = sample_log_uniform(lower, upper, shape, device)
    # Equal bounds are a constant, even for bounds <= 0 without a logarithm.
    return torch.where(lower == upper, lower.expand(shape), samples)


def _gaussian(
    lower: torch.Tensor, upper: torch.Tensor, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    return torch.randn(shape, dtype=torch.float32, device=device) * upper + lower


def _check_log_bounds(lower: float, upper: float) -> None:
    if lower != upper and min(lower, upper) <= 0.0:
        warnings.warn(
            f"log_uniform bounds: expected bounds > 0, or equal bounds for a constant, got "
            f"({lower}, {upper}), and samples are NaN; use 'uniform' for ranges that include 0.",
            UserWarning,
            stacklevel=2,
        )


def _check_deviation(mean: float, deviation: float) -> None:
    if deviation < 0.0:
        raise ValueError(
            f"gaussian bounds: expected (mean, standard deviation) with deviation >= 0, got "
            f"({mean}, {deviation})."
        )


UNIFORM = Distribution("uniform", sample_uniform)
LOG_UNIFORM = Distribution("log_uniform", _log_uniform, _check_log_bounds)
GAUSSIAN = Distribution("gaussian", _gaussian, _check_deviation)

DISTRIBUTIONS = {d.name: d for d in (UNIFORM, LOG_UNIFORM, GAUSSIAN)}

ABS = Operation("abs", torch.clone, lambda base, rnd: rnd, uses_defaults=False)
SCALE = Operation("scale", torch.ones_like, lambda base, rnd: base * rnd, uses_defaults=True)
ADD = Operation("add", torch.zeros_like, lambda base, rnd: base + rnd, uses_defaults=True)

OPERATIONS = {operation.name: operation for operation in (ABS, SCALE, ADD)}

T = TypeVar("T")


def resolve_distribution(dist: Distribution | str) -> Distribution:
    """Return the distribution called `dist`; an instance is returned unchanged.

    Raises `ValueError` for an unknown name.
    """
    return _resolve(dist, Distribution, DISTRIBUTIONS)


def resolve_operation(op: Operation | str) -> Operation:
    """Return the operation called `op`; an instance is returned unchanged.

    Raises `ValueError` for an unknown name.
    """
    return _resolve(op, Operation, OPERATIONS)


def _resolve(value: T | str, kind: type[T], known: dict[str, T]) -> T:
    if isinstance(value, kind):
        return value
    if not isinstance(value, str) or value not in known:
        raise ValueError(
            f"Unknown {kind.__name__.lower()} {value!r}. Available: {sorted(known)}, or a custom "
            f"{kind.__name__}."
        )
    return known[value]


def read_bounds(value: Any, name: str) -> tuple[float, float]:
    """Return two floats from a pair in a tuple or list.

    Raises `ValueError` naming `name` for other values.
    """
    is_pair = isinstance(value, (tuple, list)) and len(value) == 2
    if is_pair and not any(isinstance(bound, str) for bound in value):
        # Numbers of numpy and scalar tensors are numbers, too.
        with contextlib.suppress(TypeError, ValueError):
            return float(value[0]), float(value[1])
    raise ValueError(
        f"{name}: expected a pair of numbers, such as (0.8, 1.2), got {value!r} of type "
        f"{type(value).__name__}."
    )


def draw(
    distribution: Distribution, bounds: tuple[float, float], shape: tuple[int, ...], device: str
) -> torch.Tensor:
    """Sample a tensor of `shape`.

    Raises `ValueError` if the distribution rejects the bounds, or returns a shape that does not
    broadcast to `shape`.
    """
    if distribution.check is not None:
        distribution.check(*bounds)
    # Filled on the device: copies from the host would synchronize.
    lower, upper = (torch.full((), b, dtype=torch.float32, device=device) for b in bounds)
    sample = distribution.sample(lower, upper, shape, device)
    try:
        return sample.expand(shape)
    except RuntimeError as error:
        raise ValueError(
            f"Distribution {distribution.name!r}: expected samples of shape {shape}, got "
            f"{tuple(sample.shape)}."
        ) from error
