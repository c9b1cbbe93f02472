"""Sub-terrains that are a grid of cells: level ones of random height, or tilted ones."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains._boxes import GREEN, Boxes, frame_color
from mjlab.terrains._fields import (
    lerp,
    refuse_unless,
    refuse_unless_positive,
)
from mjlab.terrains._merge import merge_equal_cells
from mjlab.terrains._names import asset_name
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput
from mjlab.utils.color import brand_ramp

# What rounding errors may add to the edges of cells, in metres.
_TOLERANCE = 1e-9
# Height of frame and platform of a tilted grid, in metres.
_TILTED_HEIGHT = 0.2


@dataclass(frozen=True)
class _Grid:
    """Square cells about the middle of a sub-terrain, with a platform over some of them."""

    width: float
    """Extent of a cell, in metres."""
    counts: tuple[int, int]
    """Number of cells along x and y."""
    frame: tuple[float, float]
    """Distance of the cells from the edge of the sub-terrain, along x and y."""
    center: tuple[float, float]
    """Middle of the sub-terrain."""
    platform: float
    """Extent of the platform."""

    def place(self, i: int, j: int) -> tuple[float, float]:
        """Return the centre of cell (i, j)."""
        return (
            self.frame[0] + (i + 0.5) * self.width,
            self.frame[1] + (j + 0.5) * self.width,
        )

    def cells(self) -> Iterator[tuple[int, int]]:
        """Yield all cells, those of one x after another."""
        for i in range(self.counts[0]):
            for j in range(self.counts[1]):
                yield i, j

    def is_under_platform(self, i: int, j: int) -> bool:
        """Return whether the platform hides the whole cell."""
        return self._farthest(i, j) + self.width / 2 <= self.platform / 2 + _TOLERANCE

    def touches_platform(self, i: int, j: int) -> bool:
        """Return whether the platform hides part of the cell, or all of it."""
        return self._farthest(i, j) - self.width / 2 < self.platform / 2 - _TOLERANCE

    def is_in_cross(self, i: int, j: int) -> bool:
        """Return whether the cell's centre is in one of the strips across the platform."""
        x, y = self.place(i, j)
        apart = min(abs(x - self.center[0]), abs(y - self.center[1]))
        return apart <= self.platform / 2 + _TOLERANCE

    def _farthest(self, i: int, j: int) -> float:
        x, y = self.place(i, j)
        return max(abs(x - self.center[0]), abs(y - self.center[1]))


def _lay_out(
    cfg: BoxRandomGridTerrainCfg | BoxTiltedGridTerrainCfg, center: tuple[float, float]
) -> _Grid:
    refuse_unless_positive(cfg, "grid_width")
    counts = tuple(int((side - 2.0 * cfg.border_width) / cfg.grid_width) for side in cfg.size)
    refuse_unless(
        min(counts) >= 1, cfg, "grid_width", "no cell of that width fits between the borders."
    )
    frame = tuple(
        (side - count * cfg.grid_width) / 2 for side, count in zip(cfg.size, counts, strict=True)
    )
    return _Grid(
        cfg.grid_width, (counts[0], counts[1]), (frame[0], frame[1]), center, cfg.platform_width
    )


@dataclass(kw_only=True)
class BoxRandomGridTerrainCfg(SubTerrainCfg):
    """A grid of square columns of random height, around a platform as high as they get.

    A harder terrain has larger differences in height. The size must be square.
    """

    grid_width: float
    """Extent of a column along x and y, in metres."""
    grid_height_range: tuple[float, float]
    """Largest height of a column at difficulty 0 and 1, in metres; heights are drawn between that
    below zero and that above."""
    platform_width: float = 1.0
    """Extent of the platform in the middle, in metres."""
    holes: bool = False
    """Whether only the columns of a cross are kept, which is as wide as the platform."""
    merge_similar_heights: bool = False
    """Whether neighbours of about the same height become one box, for fewer geoms."""
    height_merge_threshold: float = 0.05
    """Multiple to which heights are rounded before merging, in metres."""
    max_merge_distance: int = 3
    """Most columns along x and y that become one box."""
    border_width: float = 0.25
    """Least width of the flat frame around the grid, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`.

        Raises:
            RuntimeError: columns fill the whole terrain and leave no frame.
            ValueError: a field makes no sense.
        """
        grid, boxes = self._check(spec)
        boxes.add_frame(grid.frame, 0.0, frame_color(GREEN), bottom=-1.0)
        highest = lerp(self.grid_height_range, difficulty)
        heights = rng.uniform(-highest, highest, grid.counts)
        merge = self.merge_similar_heights and not self.holes
        if merge:
            threshold = self.height_merge_threshold
            # Rounding must not lift a column that the platform hides in part above it.
            rounded = np.round(heights / threshold) * threshold
            heights = np.clip(rounded, -highest, highest)
        kept = np.array([self._keeps(grid, i, j) for i, j in grid.cells()]).reshape(grid.counts)
        for i, j, num_x, num_y in merge_equal_cells(
            heights, kept, self.max_merge_distance if merge else 1
        ):
            x, y = grid.place(i, j)
            shift_x, shift_y = (num_x - 1) * grid.width / 2, (num_y - 1) * grid.width / 2
            height = float(heights[i, j])
            shade = 0.5 if highest == 0.0 else (height + highest) / (2.0 * highest)
            boxes.add(
                (x + shift_x, y + shift_y), (num_x * grid.width, num_y * grid.width), height,
                brand_ramp(GREEN, float(np.clip(shade, 0.0, 1.0))), bottom=-1.0,
            )  # fmt: skip
        platform = (self.platform_width, self.platform_width)
        boxes.add_platform(platform, highest, brand_ramp(GREEN, 1.0), bottom=-1.0)
        return boxes.output(highest)

    def _check(self, spec: mujoco.MjSpec) -> tuple[_Grid, Boxes]:
        refuse_unless(self.size[0] == self.size[1], self, "size", "a random grid must be square.")
        refuse_unless(
            min(self.grid_height_range) >= 0.0, self, "grid_height_range", "it must not be below 0."
        )
        refuse_unless_positive(self, "height_merge_threshold", "max_merge_distance")
        boxes = Boxes(spec, self.size)
        grid = _lay_out(self, boxes.center)
        if min(grid.frame) <= _TOLERANCE:
            raise RuntimeError(
                f"BoxRandomGridTerrainCfg: {grid.counts[0]} columns of grid_width "
                f"{self.grid_width} m fill the size of {self.size[0]} m and leave no frame. "
                "Give a border_width, or another grid_width."
            )
        return grid, boxes

    def _keeps(self, grid: _Grid, i: int, j: int) -> bool:
        if grid.is_under_platform(i, j):
            return False
        return grid.is_in_cross(i, j) if self.holes else True


@dataclass(kw_only=True)
class BoxTiltedGridTerrainCfg(SubTerrainCfg):
    """A grid of square columns over a pit, with tilted tops, around a level platform.

    A harder terrain has larger tilts and differences in height.
    """

    grid_width: float = 1.0
    """Extent of a column along x and y, in metres."""
    tilt_range_deg: float = 15.0
    """Largest tilt about x and about y at difficulty 1, in degrees."""
    height_range: float = 0.1
    """Range of heights at difficulty 1, in metres, about that of the platform."""
    platform_width: float = 1.0
    """Extent of the platform in the middle, in metres."""
    border_width: float = 0.25
    """Least width of the flat frame around the grid, in metres."""
    floor_depth: float = 2.0
    """Depth of the pit, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        refuse_unless_positive(self, "floor_depth")
        boxes = Boxes(spec, self.size)
        grid = _lay_out(self, boxes.center)
        dark, bottom = frame_color(GREEN), -self.floor_depth
        boxes.add_pit(grid.frame, _TILTED_HEIGHT, dark, self.floor_depth)
        platform = (self.platform_width, self.platform_width)
        boxes.add_platform(platform, _TILTED_HEIGHT, dark, bottom=bottom)
        name = asset_name(spec, "tilted_column")
        for i, j in grid.cells():
            if not grid.is_under_platform(i, j):
                self._add_column(boxes, spec, grid, (i, j), f"{name}_{i}_{j}", difficulty, rng)
        return boxes.output(_TILTED_HEIGHT)

    def _add_column(
        self,
        boxes: Boxes,
        spec: mujoco.MjSpec,
        grid: _Grid,
        cell: tuple[int, int],
        name: str,
        difficulty: float,
        rng: np.random.Generator,
    ) -> None:
        tilt = math.radians(self.tilt_range_deg * difficulty)
        rise = rng.uniform(-self.height_range / 2, self.height_range / 2) * difficulty
        slopes = rng.uniform(-tilt, tilt, 2)
        shade = float(rng.uniform(0.3, 0.7))
        corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * grid.width
        tops = _TILTED_HEIGHT + rise + corners @ slopes
        if grid.touches_platform(*cell):
            # A column that reaches under the platform must not come out of it.
            tops -= max(tops.max() - _TILTED_HEIGHT, 0.0)
        bottoms = np.full(4, -self.floor_depth)
        points = np.concatenate(
            (np.column_stack((corners, bottoms)), np.column_stack((corners, tops)))
        )
        spec.add_mesh(name=name, uservert=points.ravel())
        geom = boxes.body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=(*grid.place(*cell), 0.0)
        )
        boxes.keep(geom, brand_ramp(GREEN, shade))
