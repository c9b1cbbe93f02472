"""Placing several objects so that none is in another."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    import mujoco

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
        apart: (K, K) least horizontal distances, in metres.
        x: Range of new x.
        y: Range of new y.
    """
    for index in range(1, positions.shape[1]):
        close = _too_close(positions, index, apart)
        for _ in range(_MAX_TRIES):
            rows = close.nonzero().flatten()
            if len(rows) == 0:
                break
            drawn = torch.rand(len(rows), 2, device=positions.device)
            positions[rows, index, 0] = drawn[:, 0] * (x[1] - x[0]) + x[0]
            positions[rows, index, 1] = drawn[:, 1] * (y[1] - y[0]) + y[0]
            close[rows] = _too_close(positions[rows], index, apart)


def _too_close(positions: torch.Tensor, index: int, apart: torch.Tensor) -> torch.Tensor:
    """Return whether an object is too close to one of those before it, (n,) bool."""
    offsets = positions[:, :index, :2] - positions[:, index : index + 1, :2]
    distances = torch.linalg.vector_norm(offsets, dim=-1)
    return (distances < apart[index, :index]).any(dim=1)


def distance_apart(
    model: mujoco.MjModel, geom_ids: torch.Tensor, within: Any, names: Sequence[str]
) -> torch.Tensor:
    """Return how far apart the origins of objects have to be not to touch, (K, K) in metres.

    That is the sum of the radii of the spheres about their origins that hold them: for two equal
    cubes, the diagonal of one. Warns if the range `within` is too small for all of them.

    Args:
        model: The compiled scene.
        geom_ids: (K, G) scene ids of each object's geoms; negative ones are no geom.
        within: Ranges `x` and `y` that the objects are placed in.
        names: The objects' names.
    """
    radii = torch.zeros(len(geom_ids), device=geom_ids.device)
    for row, ids in enumerate(geom_ids.tolist()):
        for geom in [geom for geom in ids if geom >= 0]:
            # As these objects have one body, a geom's position is that from the origin.
            reach = math.hypot(*model.geom_pos[geom]) + float(model.geom_rbound[geom])
            radii[row] = max(float(radii[row]), reach)
    _warn_if_crowded(radii.tolist(), within, names)
    return radii.unsqueeze(0) + radii.unsqueeze(1)


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
