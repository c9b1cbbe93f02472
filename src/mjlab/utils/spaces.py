"""Descriptions of observation and action spaces, without a dependency on a gym library."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

from mjlab.utils.errors import check_count


@dataclass
class Space:
    """Shape and type of a value."""

    shape: tuple[int, ...] = ()
    """Sizes of the axes."""
    dtype: Literal["float32", "int32", "int64", "uint8"] = "float32"
    """Type of the entries."""


@dataclass
class Box(Space):
    """An array with bounds."""

    low: float | tuple[float, ...] = -math.inf
    """Lower bound, one for all entries or one for each entry of the last axis."""
    high: float | tuple[float, ...] = math.inf
    """Upper bound, likewise."""


@dataclass
class Dict(Space):
    """Named spaces."""

    spaces: dict[str, Space] = field(default_factory=dict)
    """Name to space."""


def batch_space(space: Space, batch_size: int) -> Space:
    """Return the space of `batch_size` values at once.

    Arrays get one more leading axis. A `Dict` batches each of its spaces and has the shape
    (batch_size,). Raises `ValueError` for a batch size less than 1.
    """
    check_count("batch_size", batch_size)
    if isinstance(space, Dict):
        spaces = {name: batch_space(inner, batch_size) for name, inner in space.spaces.items()}
        return dataclasses.replace(space, shape=(batch_size,), spaces=spaces)
    return dataclasses.replace(space, shape=(batch_size, *space.shape))
