"""Observation and action spaces, without a dependency on a gym library."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

from mjlab.utils.errors import check_count


@dataclass
class Space:
    """Shape and data type of a value."""

    shape: tuple[int, ...] = ()
    """Shape."""
    dtype: Literal["float32", "int32", "int64", "uint8"] = "float32"
    """Data type."""


@dataclass
class Box(Space):
    """Bounded array."""

    low: float | tuple[float, ...] = -math.inf
    """Lower bound: a scalar, or one value per entry of the last axis."""
    high: float | tuple[float, ...] = math.inf
    """Upper bound: a scalar, or one value per entry of the last axis."""


@dataclass
class Dict(Space):
    """Dictionary of spaces."""

    spaces: dict[str, Space] = field(default_factory=dict)
    """Spaces by name."""


def batch_space(space: Space, batch_size: int) -> Space:
    """Return the space of a batch of `batch_size` values.

    Arrays get a leading batch axis. A `Dict` batches each of its spaces and has shape
    (batch_size,). Raises `ValueError` if `batch_size` < 1.
    """
    check_count("batch_size", batch_size)
    if isinstance(space, Dict):
        spaces = {name: batch_space(inner, batch_size) for name, inner in space.spaces.items()}
        return dataclasses.replace(space, shape=(batch_size,), spaces=spaces)
    return dataclasses.replace(space, shape=(batch_size, *space.shape))
