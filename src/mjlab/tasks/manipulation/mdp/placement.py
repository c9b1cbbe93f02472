"""Placing several objects so that none is in another."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from mjlab.sim import Simulation

logger = logging.getLogger(__name__)

_MAX_TRIES = 200
# Discs that are put down at random one after the other leave no room for another one once they
# cover 55 % of the ground. Well below that there is room at the first few tries.
_CROWDED = 0.35


def keep_apart(
    positions: torch.Tensor,
    apart: torch.Tensor,
    x: tuple[float, float],
    y: tuple[float, float],
) -> None:
    """Draw x and y anew, in place, of objects that are too close to one before them.

    What is far enough apart keeps its place, so that as few numbers are drawn as can be. Where 200
    tries find no room, the last one stays.

    Args:
        positions: (n, K, 3) positions of K objects.
        apart: (n, K, K) or (K, K) least horizontal distances, in metres.
        x: Range of new x.
        y: Range of new y.
    """
    apart = apart.expand(len(positions), -1, -1)
    for index in range(1, positions.shape[1]):
        close = _too_close(positions, index, apart)
        for _ in range(_MAX_TRIES):
            rows = close.nonzero().flatten()
            if len(rows) == 0:
                break
            drawn = torch.rand(len(rows), 2, dtype=torch.float32, device=positions.device)
            positions[rows, index, 0] = drawn[:, 0] * (x[1] - x[0]) + x[0]
            positions[rows, index, 1] = drawn[:, 1] * (y[1] - y[0]) + y[0]
            close[rows] = _too_close(positions[rows], index, apart[rows])


def _too_close(positions: torch.Tensor, index: int, apart: torch.Tensor) -> torch.Tensor:
    """Return whether an object is too close to one of those before it, (n,) bool."""
    offsets = positions[:, :index, :2] - positions[:, index : index + 1, :2]
    distances = torch.linalg.vector_norm(offsets, dim=-1)
    return (distances < apart[:, index, :index]).any(dim=1)


def distance_apart(
    sim: Simulation, geom_ids: torch.Tensor, within: Any, names: Sequence[str]
) -> torch.Tensor:
    """Return how far apart the origins of objects have to be not to touch, (N, K, K) in metres.

    That is the sum of the radii of the spheres about their origins that hold them: for two equal
    cubes, the diagonal of one. Variants of objects have radii of their own. Warns if the range
    `within` is too small for all of them in any environment.

    Args:
        sim: The simulation of the scene.
        geom_ids: (K, G) scene ids of each object's geoms; negative ones are no geom.
        within: Ranges `x` and `y` that the objects are placed in.
        names: The objects' names.
    """
    # As these objects have one body, a geom's position is that from the origin.
    reach = sim.model.geom_pos.norm(dim=-1) + sim.model.geom_rbound
    if sim.absent_geoms is not None:
        reach = reach.masked_fill(sim.absent_geoms, 0.0)
    radii = reach.new_zeros(len(reach), len(geom_ids))
    for ids in geom_ids.T:
        radii = torch.maximum(radii, torch.where(ids >= 0, reach[:, ids.clamp(min=0)], 0.0))
    largest = int(radii.square().sum(dim=1).argmax())
    _warn_if_crowded(radii[largest].tolist(), within, names)
    return radii.unsqueeze(1) + radii.unsqueeze(2)


def _warn_if_crowded(radii: list[float], within: Any, names: Sequence[str]) -> None:
    widest = 2.0 * max(radii)
    sides = [high - low + widest for low, high in (within.x, within.y)]
    covered = sum(math.pi * radius**2 for radius in radii)
    if len(radii) > 1 and covered > _CROWDED * sides[0] * sides[1]:
        logger.warning(
            "object_pose_range is small for the %d objects %s: some may be put into one another, "
            "and are then thrown apart. Widen x or y, or take fewer or smaller objects.",
            len(radii),
            list(names),
        )
