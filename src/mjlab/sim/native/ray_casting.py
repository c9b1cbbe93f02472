"""One query of `Batch.ray`, repeated for the rays that hit what they have to pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Array = np.ndarray
Passed = Callable[[Any, Array, Array, "Hits"], Array]
"""Which hits of some rows do not count: rows, their origins, directions and hits to (n, R) bool."""

# So many surfaces that do not count are passed by one ray; the next one ends it.
_MAX_PASSES = 8
# A passed ray starts again so far behind the surface, in metres, and relative to its coordinates,
# which are single precision.
_BEHIND, _BEHIND_RELATIVE = 1e-5, 1e-6


class Hits:
    """What rays met: distances (n, R), normals (n, R, 3), geoms (n, R); -1, 0 and -1 on a miss."""

    def __init__(self, distances: Array, normals: Array, geoms: Array) -> None:
        self.distances, self.normals, self.geoms = distances, normals, geoms

    @classmethod
    def empty(cls, rows: int, rays: int) -> Hits:
        """Allocate results, of any values."""
        return cls(
            np.empty((rows, rays), np.float32),
            np.empty((rows, rays, 3), np.float32),
            np.empty((rows, rays), np.int32),
        )

    def __getitem__(self, rows: Any) -> Hits:
        return Hits(self.distances[rows], self.normals[rows], self.geoms[rows])

    def forget(self, where: Array) -> None:
        """Make the rays `where` (n, R) bool misses."""
        self.distances[where], self.normals[where], self.geoms[where] = -1.0, 0.0, -1

    def take_nearer(self, other: Hits) -> None:
        """Replace the hits that `other` has nearer."""
        nearer = (other.distances >= 0.0) & (
            (other.distances < self.distances) | (self.distances < 0.0)
        )
        if nearer.any():
            self.distances[nearer] = other.distances[nearer]
            self.normals[nearer] = other.normals[nearer]
            self.geoms[nearer] = other.geoms[nearer]


def cast_through(
    batch: Any,
    origins: Array,
    directions: Array,
    hits: Hits,
    passed: Passed | None,
    rows: Array | None = None,
    **options: Any,
) -> None:
    """Cast the rays of `rows` (None: all), through surfaces that do not count, into `hits`.

    Args:
        batch: The simulations, one a row.
        origins: (n, R, 3). directions: (n, R, 3).
        hits: Where the results go.
        passed: Which hits do not count; None if all do.
        rows: Sorted ids of simulations.
        options: Further arguments of `Batch.ray`.
    """
    gone: Array | None = None
    for attempt in range(_MAX_PASSES + 1):
        some = slice(None) if rows is None else rows
        hits.distances[some], hits.geoms[some], hits.normals[some] = batch.ray(
            origins[some], directions[some], ids=rows, normal=True, **options
        )
        if passed is None:
            return
        found = hits[some]
        repeat = passed(some, origins[some], directions[some], found)
        chosen = repeat.any(axis=1)
        if not chosen.any():
            break
        if gone is None:
            origins, gone = origins.copy(), np.zeros_like(hits.distances)
        rows = np.flatnonzero(chosen) if rows is None else rows[chosen]
        repeat = repeat[chosen]
        if attempt == _MAX_PASSES:
            last = hits[rows]
            last.forget(repeat)
            hits.distances[rows], hits.normals[rows] = last.distances, last.normals
            hits.geoms[rows] = last.geoms
            break
        behind = _BEHIND + _BEHIND_RELATIVE * np.abs(origins[rows]).max(axis=-1)
        step = np.where(repeat, hits.distances[rows] + behind, 0.0).astype(np.float32)
        origins[rows] += step[..., None] * directions[rows]
        gone[rows] += step
    if gone is not None:
        hits.distances += np.where(hits.distances >= 0.0, gone, 0.0)
