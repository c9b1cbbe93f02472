"""Builder of box sub-terrains: solid boxes, rings, frames and pits, and their colors."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from mjlab.terrains.terrain_generator import TerrainGeometry, TerrainOutput
from mjlab.terrains.utils import add_box
from mjlab.utils.color import brand_ramp, darken_rgba

RGBA = tuple[float, float, float, float]

BLUE = (0.20, 0.45, 0.95)
RED = (0.90, 0.30, 0.30)
GREEN = (0.25, 0.80, 0.45)

# A thin sheet lets fast or deep contacts through to the other side.
MIN_THICKNESS = 0.5

# Boxes narrower than this are rounding errors of a layout that leaves no room for them.
_NO_LENGTH = 1e-9


class Boxes:
    """Adds boxes to the terrain, in the frame of one sub-terrain, and keeps them in order.

    A box is given by its top, and reaches down at least half a metre unless it is a slab.
    """

    def __init__(self, spec: mujoco.MjSpec, size: tuple[float, float]) -> None:
        """Start a sub-terrain of the given extent along x and y, in metres."""
        self.body = spec.body("terrain")
        self.size = size
        self.geometries: list[TerrainGeometry] = []
        """What was added so far."""

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the sub-terrain, in metres from its corner."""
        return self.size[0] / 2, self.size[1] / 2

    def output(self, height: float) -> TerrainOutput:
        """Return all boxes, with the spawn point in the middle at a height in metres."""
        return TerrainOutput(origin=np.array([*self.center, height]), geometries=self.geometries)

    def keep(self, geom: mujoco.MjsGeom, color: RGBA) -> None:
        """Take up a geom that was added otherwise."""
        self.geometries.append(TerrainGeometry(geom=geom, color=color))

    def add(
        self,
        center: tuple[float, float],
        extent: tuple[float, float],
        top: float,
        color: RGBA,
        bottom: float = math.inf,
        yaw: float = 0.0,
        slab: float | None = None,
    ) -> None:
        """Add a box.

        Args:
            center: Its middle along x and y, in metres.
            extent: Its length along its own x and y axes.
            top: Height of its top.
            color: Its colour where colours show height.
            bottom: Height of its bottom; lower where it would be thinner than half a metre.
            yaw: Rotation about z, in radians.
            slab: Thickness of a box with nothing below; None for a solid one.
        """
        low = min(bottom, top - MIN_THICKNESS) if slab is None else top - slab
        geom = add_box(self.body, (*center, (low + top) / 2), (*extent, top - low))
        if yaw != 0.0:
            geom.quat = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self.keep(geom, color)

    def add_ring(
        self,
        outer: tuple[float, float],
        width: float | tuple[float, float],
        top: float,
        color: RGBA,
        bottom: float = math.inf,
        slab: float | None = None,
        arms: float | None = None,
        order: str = "+y -y +x -x",
    ) -> None:
        """Add a rectangular ring about the middle, of four boxes. Those along x span its length.

        Args:
            outer: Its outer extent along x and y, in metres.
            width: Its width; a pair is that of the boxes across x, and of those across y.
            top: Height of its top.
            color: Its colour where colours show height.
            bottom: As in `add`.
            slab: As in `add`.
            arms: Length of each box, in the middle of its side, instead of that of the side.
            order: Sides in the order in which they are added.
        """
        width_x, width_y = width if isinstance(width, tuple) else (width, width)
        width_x, width_y = min(width_x, outer[0] / 2), min(width_y, outer[1] / 2)
        along_x = outer[0] if arms is None else arms
        along_y = outer[1] - 2.0 * width_y if arms is None else arms
        off_x, off_y = (outer[0] - width_x) / 2, (outer[1] - width_y) / 2
        sides = {
            "+y": (0.0, off_y, along_x, width_y),
            "-y": (0.0, -off_y, along_x, width_y),
            "+x": (off_x, 0.0, width_x, along_y),
            "-x": (-off_x, 0.0, width_x, along_y),
        }
        x, y = self.center
        for side in order.split():
            dx, dy, length_x, length_y = sides[side]
            if min(length_x, length_y) > _NO_LENGTH:
                place, extent = (x + dx, y + dy), (length_x, length_y)
                self.add(place, extent, top, color, bottom=bottom, slab=slab)

    def add_frame(
        self,
        width: float | tuple[float, float],
        top: float,
        color: RGBA,
        bottom: float = math.inf,
    ) -> None:
        """Add the frame along the edge of the sub-terrain, if it has a width (as in a ring)."""
        if np.min(width) > 0.0:
            self.add_ring(self.size, width, top, color, bottom=bottom, order="+y -y -x +x")

    def add_platform(
        self, extent: tuple[float, float], top: float, color: RGBA, bottom: float = math.inf
    ) -> None:
        """Add a box in the middle."""
        self.add(self.center, extent, top, color, bottom=bottom)

    def add_pit(
        self, width: float | tuple[float, float], top: float, color: RGBA, depth: float
    ) -> None:
        """Add a pit over the whole sub-terrain: its black floor, and the frame down to there."""
        self.add_frame(width, top, color, bottom=-depth)
        self.add_platform(self.size, -depth, (0.1, 0.1, 0.1, 1.0))


def merge_equal_cells(
    values: np.ndarray, kept: np.ndarray, longest: int
) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles of equal values that together hold each kept cell once.

    Cells are scanned along the second axis first. From each that is not taken yet, a rectangle
    grows along the first axis and then, by whole rows, along the second.

    Args:
        values: (n, m) values.
        kept: (n, m) whether each cell counts.
        longest: Most cells along an axis of a rectangle.

    Yields:
        First cell along both axes, and number of cells along both.
    """
    free = kept.copy()
    for i, j in np.argwhere(kept).tolist():
        if not free[i, j]:
            continue
        same = free & (values == values[i, j])
        # `argmin` finds the first cell that is not equal; appended, there is always one.
        num_i = int(np.argmin(np.append(same[i : i + longest, j], False)))
        block = same[i : i + num_i, j : j + longest].all(axis=0)
        num_j = int(np.argmin(np.append(block, False)))
        free[i : i + num_i, j : j + num_j] = False
        yield i, j, num_i, num_j


def frame_color(base: tuple[float, float, float]) -> RGBA:
    """Return the colour of the frame of a sub-terrain that has the base colour."""
    return darken_rgba(brand_ramp(base, 0.0), 0.85)


def inset(extent: tuple[float, float], by: float) -> tuple[float, float]:
    """Return the extent of a rectangle made smaller by a distance on each side."""
    return extent[0] - 2.0 * by, extent[1] - 2.0 * by
