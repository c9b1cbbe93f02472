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

# Boxes narrower than this (m) are rounding errors of a layout without room for them.
_NO_LENGTH = 1e-9


class Boxes:
    """Builder of one sub-terrain's boxes, in its frame. Keeps the geoms in order.

    A box is defined by its top, and is at least 0.5 m thick unless it is a slab.
    """

    def __init__(self, spec: mujoco.MjSpec, size: tuple[float, float]) -> None:
        """Start a sub-terrain with this extent along x and y (m)."""
        self.body = spec.body("terrain")
        self.size = size
        self.geometries: list[TerrainGeometry] = []
        """Geoms added so far."""

    @property
    def center(self) -> tuple[float, float]:
        """Center of the sub-terrain relative to its corner (m)."""
        return self.size[0] / 2, self.size[1] / 2

    def output(self, height: float) -> TerrainOutput:
        """Return all boxes, with the spawn point at the center and `height` (m)."""
        return TerrainOutput(origin=np.array([*self.center, height]), geometries=self.geometries)

    def keep(self, geom: mujoco.MjsGeom, color: RGBA) -> None:
        """Register a geom added without `add`."""
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
            center: Center along x and y (m).
            extent: Extent along the box's x and y axes (m).
            top: Height of the top (m).
            color: Color under the scheme `height`.
            bottom: Height of the bottom (m). Lowered if the box would be thinner than 0.5 m.
            yaw: Rotation about z (rad).
            slab: Thickness of a slab (m). None: solid box.
        """
        low = min(bottom, top - MIN_THICKNESS) if slab is None else top - slab
        geom = add_box(self.body, (*center, (low + top) / 2), (*extent, top - low))
        if yaw != 0.0:
            geom.quat = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        self.keep(geom, color)

    def add_off_center(
        self, offset: np.ndarray, extent: np.ndarray, top: float, color: RGBA, **options: float
    ) -> None:
        """Add a box with its center at an offset (m), (2,), from the center; see `add`."""
        x, y = (np.array(self.center) + offset).tolist()
        length_x, length_y = extent.tolist()
        self.add((x, y), (length_x, length_y), top, color, **options)

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
        """Add a rectangular ring of four boxes about the center. The ±y boxes span the full length.

        Args:
            outer: Outer extent along x and y (m).
            width: Width (m). A pair: widths of the ±x and of the ±y boxes.
            top: Height of the top (m).
            color: Color under the scheme `height`.
            bottom: As in `add`.
            slab: As in `add`.
            arms: Length of each box, centered on its side (m). None: full side.
            order: Order of the sides.
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

    def add_border(
        self,
        width: float | tuple[float, float],
        top: float,
        color: RGBA,
        bottom: float = math.inf,
    ) -> None:
        """Add a border along the edge of the sub-terrain if `width` (as in `add_ring`) is > 0."""
        if np.min(width) > 0.0:
            self.add_ring(self.size, width, top, color, bottom=bottom, order="+y -y -x +x")

    def add_platform(
        self, extent: tuple[float, float], top: float, color: RGBA, bottom: float = math.inf
    ) -> None:
        """Add a box at the center."""
        self.add(self.center, extent, top, color, bottom=bottom)

    def add_pit(
        self, width: float | tuple[float, float], top: float, color: RGBA, depth: float
    ) -> None:
        """Add a pit over the whole sub-terrain: black floor, and a border down to the floor."""
        self.add_border(width, top, color, bottom=-depth)
        self.add_platform(self.size, -depth, (0.1, 0.1, 0.1, 1.0))


def merge_equal_cells(
    values: np.ndarray, kept: np.ndarray, longest: int
) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles of equal values that together hold each kept cell once.

    Cells are scanned along the second axis first. From each unused cell, a rectangle grows along
    the first axis and then, by whole rows, along the second.

    Args:
        values: (n, m) values.
        kept: (n, m) mask of the cells to cover.
        longest: Maximum number of cells along an axis of a rectangle.

    Yields:
        First cell along both axes, and number of cells along both.
    """
    free = kept.copy()
    for i, j in np.argwhere(kept).tolist():
        if not free[i, j]:
            continue
        same = free & (values == values[i, j])
        # `argmin` finds the first unequal cell; the appended False guarantees one.
        num_i = int(np.argmin(np.append(same[i : i + longest, j], False)))
        block = same[i : i + num_i, j : j + longest].all(axis=0)
        num_j = int(np.argmin(np.append(block, False)))
        free[i : i + num_i, j : j + num_j] = False
        yield i, j, num_i, num_j


def border_color(base: tuple[float, float, float]) -> RGBA:
    """Return the border color of a sub-terrain with this base color."""
    return darken_rgba(brand_ramp(base, 0.0), 0.85)


def inset(extent: tuple[float, float], by: float) -> tuple[float, float]:
    """Return the extent of a rectangle shrunk by a distance (m) on each side."""
    return extent[0] - 2.0 * by, extent[1] - 2.0 * by
