"""Box sub-terrains: stairs, grids (also of convex columns), obstacles, and terrains over a pit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains.boxes import (
    BLUE,
    GREEN,
    MIN_THICKNESS,
    RED,
    RGBA,
    Boxes,
    border_color,
    inset,
    merge_equal_cells,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput, asset_name
from mjlab.terrains.utils import lerp
from mjlab.utils.color import brand_ramp

# Tolerance for rounding errors of cell edges (m).
_TOLERANCE = 1e-9

# Height of border and platform of a tilted grid (m).
_TILTED_HEIGHT = 0.2

# Minimum extent of stones clipped at the border (m). Smaller stones are dropped.
_MIN_STONE = 0.05

# Minimum length of beams (m). Shorter beams are dropped: there the platform meets the border.
_MIN_BEAM = 0.01


@dataclass(kw_only=True)
class BoxFlatTerrainCfg(SubTerrainCfg):
    """Flat ground at z = 0, at every difficulty."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        boxes.add_platform(self.size, 0.0, (0.5, 0.5, 0.5, 1.0), bottom=-1.0)
        return boxes.output(0.0)


# Stairs in square rings that rise or descend towards a central platform.


@dataclass(kw_only=True)
class BoxPyramidStairsTerrainCfg(SubTerrainCfg):
    """Stairs that rise from all sides to a platform.

    Difficulty increases the step height. The platform is one step above the last step.
    """

    border_width: float = 0.0
    """Width of the flat border around the stairs (m)."""
    step_height_range: tuple[float, float]
    """Step height at difficulty 0 and 1 (m)."""
    step_width: float
    """Step depth (m)."""
    platform_width: float = 1.0
    """Minimum extent of the platform (m)."""
    holes: bool = False
    """Use steps as long as the platform is wide, with holes at the corners."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        return self._make(difficulty, spec, BLUE, direction=1)

    def _make(
        self,
        difficulty: float,
        spec: mujoco.MjSpec,
        base: tuple[float, float, float],
        direction: int,
    ) -> TerrainOutput:
        """Add stairs that rise (direction 1) or descend (-1) towards the center."""
        boxes = Boxes(spec, self.size)
        height = lerp(self.step_height_range, difficulty)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, self.step_width)
        if not self.holes:
            boxes.add_border(self.border_width, 0.0, border_color(base), bottom=-height)
        last = direction * (count + 1) * height
        # Rising steps extend below the surrounding ground, descending steps to the platform.
        bottom = -height if direction > 0 else last
        for step in range(count):
            boxes.add_ring(
                inset(inner, step * self.step_width),
                self.step_width,
                direction * (step + 1) * height,
                _shade(base, step, count),
                bottom=bottom,
                arms=self.platform_width if self.holes else None,
            )
        platform = inset(inner, count * self.step_width)
        boxes.add_platform(platform, last, brand_ramp(base, 1.0), bottom=bottom)
        return boxes.output(last)


@dataclass(kw_only=True)
class BoxInvertedPyramidStairsTerrainCfg(BoxPyramidStairsTerrainCfg):
    """Stairs that descend from all sides to a platform."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        return self._make(difficulty, spec, RED, direction=-1)


@dataclass(kw_only=True)
class BoxOpenStairsTerrainCfg(SubTerrainCfg):
    """Stairs of slabs with open space below.

    Difficulty increases the step height and decreases the step depth.
    """

    step_height_range: tuple[float, float] = (0.1, 0.2)
    """Step height at difficulty 0 and 1 (m)."""
    step_width_range: tuple[float, float] = (0.4, 0.8)
    """Step depth at difficulty 1 and 0 (m)."""
    platform_width: float = 1.0
    """Minimum extent of the central platform (m)."""
    border_width: float = 0.25
    """Width of the flat border around the stairs (m)."""
    step_thickness: float = 0.05
    """Thickness of the slabs (m)."""
    inverted: bool = True
    """Descend towards the platform. The first step is then level with the border, and the platform
    one step below the last step."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        height = lerp(self.step_height_range, difficulty)
        width = lerp(self.step_width_range[::-1], difficulty)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, width)
        boxes.add_border(self.border_width, 0.0, border_color(BLUE), bottom=-height)
        tops = [-k * height if self.inverted else (k + 1) * height for k in range(count + 1)]
        slab = self.step_thickness
        for step in range(count):
            shade = _shade(BLUE, step, count)
            boxes.add_ring(inset(inner, step * width), width, tops[step], shade, slab=slab)
        platform = inset(inner, count * width)
        boxes.add(boxes.center, platform, tops[count], brand_ramp(BLUE, 1.0), slab=slab)
        return boxes.output(tops[count])


@dataclass(kw_only=True)
class BoxRandomStairsTerrainCfg(SubTerrainCfg):
    """Stairs with random step heights that rise to a platform.

    Difficulty scales the sampled heights: by 0.5 at difficulty 0, by 1 at difficulty 1.
    """

    step_width: float = 0.8
    """Step depth (m)."""
    step_height_range: tuple[float, float] = (0.1, 0.3)
    """Range of random step heights (m)."""
    platform_width: float = 1.0
    """Minimum extent of the central platform, level with the last step (m)."""
    border_width: float = 0.25
    """Width of the flat border around the stairs (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, self.step_width)
        boxes.add_border(self.border_width, 0.0, border_color(BLUE))
        top = 0.0
        for step in range(count):
            top += float(rng.uniform(*self.step_height_range)) * (0.5 + 0.5 * difficulty)
            extent = inset(inner, step * self.step_width)
            shade = _shade(BLUE, step, count)
            boxes.add_ring(extent, self.step_width, top, shade, bottom=-MIN_THICKNESS)
        platform = inset(inner, count * self.step_width)
        boxes.add_platform(platform, top, brand_ramp(BLUE, 1.0), bottom=-MIN_THICKNESS)
        return boxes.output(top)


def _count_steps(inner: tuple[float, float], platform: float, step_width: float) -> int:
    """Return the number of step rings that fit between border and platform."""
    return max(0, min(int((side - platform) / (2.0 * step_width)) for side in inner))


def _shade(base: tuple[float, float, float], step: int, count: int) -> RGBA:
    return brand_ramp(base, step / max(count - 1, 1))


# Grids of columns: with random heights, or with tilted tops.


@dataclass(kw_only=True)
class BoxRandomGridTerrainCfg(SubTerrainCfg):
    """Grid of square columns with random heights, around a platform of maximum height.

    Difficulty increases the height range.
    """

    grid_width: float
    """Column extent along x and y (m)."""
    grid_height_range: tuple[float, float]
    """Maximum column height h at difficulty 0 and 1 (m). Heights are sampled from [-h, h]."""
    platform_width: float = 1.0
    """Extent of the central platform (m)."""
    holes: bool = False
    """Keep only the columns of a cross as wide as the platform."""
    merge_similar_heights: bool = False
    """Merge neighboring columns of similar height into one box, to reduce the number of geoms."""
    height_merge_threshold: float = 0.05
    """Step to round heights to before merging (m)."""
    max_merge_distance: int = 3
    """Maximum number of columns per merged box, along each of x and y."""
    border_width: float = 0.25
    """Minimum width of the flat border around the grid (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        grid = _lay_out(self, boxes.center)
        boxes.add_border(grid.border, 0.0, border_color(GREEN), bottom=-1.0)
        highest = lerp(self.grid_height_range, difficulty)
        heights = rng.uniform(-highest, highest, grid.counts)
        merge = self.merge_similar_heights and not self.holes
        if merge:
            threshold = self.height_merge_threshold
            # Rounding must not lift partly covered columns above the platform.
            rounded = np.round(heights / threshold) * threshold
            heights = np.clip(rounded, -highest, highest)
        kept = [
            not grid.is_under_platform(i, j) and (not self.holes or grid.is_in_cross(i, j))
            for i, j in grid.cells()
        ]
        kept = np.array(kept).reshape(grid.counts)
        for i, j, num_x, num_y in merge_equal_cells(
            heights, kept, max(self.max_merge_distance, 1) if merge else 1
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


@dataclass(kw_only=True)
class BoxTiltedGridTerrainCfg(SubTerrainCfg):
    """Grid of square columns with tilted tops over a pit, around a level platform.

    Difficulty increases tilts and height differences.
    """

    grid_width: float = 1.0
    """Column extent along x and y (m)."""
    tilt_range_deg: float = 15.0
    """Maximum tilt about each of x and y at difficulty 1 (deg)."""
    height_range: float = 0.1
    """Height range at difficulty 1, centered on the platform height (m)."""
    platform_width: float = 1.0
    """Extent of the central platform (m)."""
    border_width: float = 0.25
    """Minimum width of the flat border around the grid (m)."""
    floor_depth: float = 2.0
    """Pit depth (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        grid = _lay_out(self, boxes.center)
        dark, bottom = border_color(GREEN), -self.floor_depth
        boxes.add_pit(grid.border, _TILTED_HEIGHT, dark, self.floor_depth)
        platform = (self.platform_width, self.platform_width)
        boxes.add_platform(platform, _TILTED_HEIGHT, dark, bottom=bottom)
        name = asset_name(spec, "tilted_column")
        tilt, rise = math.radians(self.tilt_range_deg * difficulty), self.height_range / 2
        corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * grid.width
        for i, j in grid.cells():
            if grid.is_under_platform(i, j):
                continue
            middle = _TILTED_HEIGHT + rng.uniform(-rise, rise) * difficulty
            tops = middle + corners @ rng.uniform(-tilt, tilt, 2)
            shade = float(rng.uniform(0.3, 0.7))
            if grid.touches_platform(i, j):
                # A column that extends under the platform must not protrude through the platform.
                tops -= max(tops.max() - _TILTED_HEIGHT, 0.0)
            heights = np.concatenate((np.full(4, bottom), tops))
            points = np.column_stack((np.tile(corners, (2, 1)), heights))
            column = spec.add_mesh(name=f"{name}_{i}_{j}", uservert=points.ravel())
            geom = boxes.body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH, meshname=column.name, pos=(*grid.place(i, j), 0.0)
            )
            boxes.keep(geom, brand_ramp(GREEN, shade))
        return boxes.output(_TILTED_HEIGHT)


@dataclass(frozen=True)
class _Grid:
    """Grid of square cells about the center of a sub-terrain, partly covered by a platform."""

    width: float
    """Cell extent (m)."""
    counts: tuple[int, int]
    """Number of cells along x and y."""
    border: tuple[float, float]
    """Distance of the cells from the edge of the sub-terrain along x and y (m)."""
    center: tuple[float, float]
    """Center of the sub-terrain (m)."""
    platform: float
    """Platform extent (m)."""

    def place(self, i: int, j: int) -> tuple[float, float]:
        """Return the center of cell (i, j)."""
        return (
            self.border[0] + (i + 0.5) * self.width,
            self.border[1] + (j + 0.5) * self.width,
        )

    def cells(self) -> Iterator[tuple[int, int]]:
        """Yield all cells (i, j), j fastest."""
        for i in range(self.counts[0]):
            for j in range(self.counts[1]):
                yield i, j

    def is_under_platform(self, i: int, j: int) -> bool:
        """Return True if the platform covers the whole cell."""
        return self._farthest(i, j) + self.width / 2 <= self.platform / 2 + _TOLERANCE

    def touches_platform(self, i: int, j: int) -> bool:
        """Return True if the platform covers part of the cell, or the whole cell."""
        return self._farthest(i, j) - self.width / 2 < self.platform / 2 - _TOLERANCE

    def is_in_cross(self, i: int, j: int) -> bool:
        """Return True if the cell's center is in a strip along x or y through the platform."""
        x, y = self.place(i, j)
        apart = min(abs(x - self.center[0]), abs(y - self.center[1]))
        return apart <= self.platform / 2 + _TOLERANCE

    def _farthest(self, i: int, j: int) -> float:
        x, y = self.place(i, j)
        return max(abs(x - self.center[0]), abs(y - self.center[1]))


def _lay_out(
    cfg: BoxRandomGridTerrainCfg | BoxTiltedGridTerrainCfg, center: tuple[float, float]
) -> _Grid:
    # A negative width has negative numbers of cells, and so none.
    counts = tuple(int((side - 2.0 * cfg.border_width) / cfg.grid_width) for side in cfg.size)
    border = tuple(
        (side - count * cfg.grid_width) / 2 for side, count in zip(cfg.size, counts, strict=True)
    )
    return _Grid(
        cfg.grid_width, (counts[0], counts[1]), (border[0], border[1]), center, cfg.platform_width
    )


# Boxes on flat ground.


@dataclass(kw_only=True)
class BoxRandomSpreadTerrainCfg(SubTerrainCfg):
    """Boxes of random size, position and yaw around a free square.

    Difficulty increases number and height of boxes. Boxes that overlap the square are dropped.
    """

    num_boxes: int = 60
    """Number of boxes at difficulty 1. Half at difficulty 0."""
    box_width_range: tuple[float, float] = (0.3, 1.0)
    """Range of box lengths along the box's x axis (m)."""
    box_length_range: tuple[float, float] = (0.3, 1.0)
    """Range of box lengths along the box's y axis (m)."""
    box_height_range: tuple[float, float] = (0.05, 1.0)
    """Range of box heights at difficulty 1 (m). One fifth at difficulty 0."""
    box_yaw_range: tuple[float, float] = (0.0, 360.0)
    """Range of box rotations about z (deg)."""
    add_floor: bool = True
    """Add ground between the boxes. Otherwise only a central platform."""
    platform_width: float = 1.0
    """Extent of the central square (m)."""
    border_width: float = 0.25
    """Width of the flat border around the boxes (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        boxes.add_border(self.border_width, 0.0, border_color(BLUE), bottom=-1.0)
        inner = inset(self.size, self.border_width)
        ground = inner if self.add_floor else (self.platform_width, self.platform_width)
        boxes.add_platform(ground, 0.0, border_color(BLUE), bottom=-1.0 * (not self.add_floor))
        for _ in range(int(self.num_boxes * (0.5 + 0.5 * difficulty))):
            self._add_obstacle(boxes, inner, difficulty, rng)
        return boxes.output(0.0)

    def _add_obstacle(
        self,
        boxes: Boxes,
        inner: tuple[float, float],
        difficulty: float,
        rng: np.random.Generator,
    ) -> None:
        length = np.array([rng.uniform(*self.box_width_range), rng.uniform(*self.box_length_range)])
        top = float(rng.uniform(*self.box_height_range)) * (0.2 + 0.8 * difficulty)
        room = np.maximum(np.array(inner) - length, 0.0) / 2
        place = np.array([rng.uniform(-room[0], room[0]), rng.uniform(-room[1], room[1])])
        yaw = math.radians(rng.uniform(*self.box_yaw_range))
        # The sampling ranges above keep only the unrotated box inside the border.
        limit = np.array(inner) / 2 - _rotated_extent(length, yaw) / 2
        place = np.clip(place, -limit, limit)
        if (limit < 0.0).any() or _touches_square(place, length, yaw, self.platform_width):
            return
        color = brand_ramp(BLUE, float(rng.uniform(0.3, 0.8)))
        boxes.add_off_center(place, length, top, color, bottom=0.0, yaw=yaw)


def _rotated_extent(length: np.ndarray, yaw: float) -> np.ndarray:
    """Return the extent along x and y of a rectangle rotated by yaw, (2,)."""
    cos, sin = abs(math.cos(yaw)), abs(math.sin(yaw))
    return np.array([length[0] * cos + length[1] * sin, length[0] * sin + length[1] * cos])


def _touches_square(center: np.ndarray, length: np.ndarray, yaw: float, side: float) -> bool:
    """Return True if a rotated rectangle touches a square centered on the origin.

    Separating axis test: two rectangles are disjoint if their projections onto an axis of one of
    them are disjoint.
    """
    if (abs(center) > (_rotated_extent(length, yaw) + side) / 2).any():
        return False
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = np.array([center[0] * cos + center[1] * sin, -center[0] * sin + center[1] * cos])
    square = _rotated_extent(np.array([side, side]), yaw)
    return bool((abs(along) <= (square + length) / 2).all())


# Terrains over a pit: stepping stones, beams, and nested rings.


@dataclass(kw_only=True)
class BoxSteppingStonesTerrainCfg(SubTerrainCfg):
    """Grid of stepping stones over a pit, around a platform.

    Difficulty decreases the stone size, and increases variations of size, position and height.
    """

    stone_size_range: tuple[float, float] = (0.4, 0.8)
    """Stone extent at difficulty 1 and 0 (m)."""
    stone_distance_range: tuple[float, float] = (0.2, 0.5)
    """First: minimum gap between stones at difficulty 0 (m). Second: no effect, because gaps grow
    as stones shrink."""
    stone_height: float = 0.2
    """Height of stones, platform and border (m)."""
    stone_height_variation: float = 0.1
    """Maximum deviation of stone heights at difficulty 1 (m)."""
    stone_size_variation: float = 0.1
    """Maximum deviation of stone extents at difficulty 1 (m)."""
    floor_depth: float = 2.0
    """Pit depth (m)."""
    displacement_range: float = 0.1
    """Maximum displacement of stones along x and y at difficulty 1 (m)."""
    platform_width: float = 1.0
    """Minimum extent of the central platform (m)."""
    border_width: float = 0.25
    """Width of the border (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        side = lerp(self.stone_size_range[::-1], difficulty)
        inner = np.array(inset(self.size, self.border_width))
        min_pitch = self.stone_size_range[1] + self.stone_distance_range[0]
        counts = np.maximum(2, np.floor(inner / min_pitch).astype(int) + 1)
        pitch = inner / (counts - 1)
        reach = self._platform_reach(side, inner, counts, pitch)
        dark, bottom = border_color(GREEN), -self.floor_depth
        boxes.add_pit(self.border_width, self.stone_height, dark, self.floor_depth)
        platform = (2.0 * float(reach[0]), 2.0 * float(reach[1]))
        boxes.add_platform(platform, self.stone_height, dark, bottom=bottom)
        for i in range(counts[0]):
            for j in range(counts[1]):
                place = (np.array([i, j]) * pitch) - inner / 2
                self._add_stone(boxes, place, side, inner / 2, reach, difficulty, rng)
        return boxes.output(self.stone_height)

    def _platform_reach(
        self, side: float, inner: np.ndarray, counts: np.ndarray, pitch: np.ndarray
    ) -> np.ndarray:
        """Return half extents of the platform with the stone gap to the next stones, (2,)."""
        gap = np.maximum(0.0, pitch - side)
        least = self.platform_width / 2
        # The first stone along each axis at least one gap beyond the minimum platform.
        beyond = (inner / 2 + least + side / 2 + gap) / pitch
        index = np.minimum(counts - 1, np.ceil(beyond))
        return np.maximum(least, index * pitch - inner / 2 - side / 2 - gap)

    def _add_stone(
        self,
        boxes: Boxes,
        place: np.ndarray,
        side: float,
        room: np.ndarray,
        reach: np.ndarray,
        difficulty: float,
        rng: np.random.Generator,
    ) -> None:
        """Add one stone, unless its center is on the platform or the clipped stone is too small."""
        shift, vary = self.displacement_range * difficulty, self.stone_size_variation * difficulty
        place = place + rng.uniform(-shift, shift, 2)
        half = (side + rng.uniform(-vary, vary, 2)) / 2
        low, high = np.maximum(place - half, -room), np.minimum(place + half, room)
        if (abs(place) <= reach).all() or (high - low < _MIN_STONE).any():
            return
        rise = self.stone_height_variation * difficulty
        top = self.stone_height + float(rng.uniform(-rise, rise))
        color = brand_ramp(GREEN, float(rng.uniform(0.4, 0.7)))
        boxes.add_off_center((low + high) / 2, high - low, top, color, bottom=-self.floor_depth)


@dataclass(kw_only=True)
class BoxNarrowBeamsTerrainCfg(SubTerrainCfg):
    """Radial beams over a pit, from a platform to the border.

    Difficulty decreases the beam width.
    """

    num_beams: int = 16
    """Number of beams."""
    beam_width_range: tuple[float, float] = (0.2, 0.4)
    """Beam width at difficulty 1 and 0 (m)."""
    beam_height: float = 0.2
    """Height of beams, platform and border (m)."""
    spacing: float = 0.8
    """No effect: beams are at equal angles."""
    platform_width: float = 1.0
    """Maximum extent of the central platform (m). Reduced until adjacent beams meet at the
    platform."""
    border_width: float = 0.25
    """Width of the border (m)."""
    floor_depth: float = 2.0
    """Pit depth (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        width = lerp(self.beam_width_range[::-1], difficulty)
        radius = self.platform_width / 2
        if self.num_beams > 1:
            chord = 2.0 * math.sqrt(2.0) * math.sin(math.pi / self.num_beams)
            radius = min(radius, width / chord)
        dark, bottom, top = border_color(BLUE), -self.floor_depth, self.beam_height
        boxes.add_pit(self.border_width, top, dark, self.floor_depth)
        boxes.add_platform((2.0 * radius, 2.0 * radius), top, dark, bottom=bottom)
        for index in range(int(self.num_beams)):
            angle = 2.0 * math.pi * index / self.num_beams
            length = self._reach(angle, width) - radius
            if length < _MIN_BEAM:
                continue
            middle = radius + length / 2
            place = (
                boxes.center[0] + middle * math.cos(angle),
                boxes.center[1] + middle * math.sin(angle),
            )
            shade = brand_ramp(BLUE, index / max(self.num_beams - 1, 1))
            boxes.add(place, (length, width), top, shade, bottom=bottom, yaw=angle)
        return boxes.output(top)

    def _reach(self, angle: float, width: float) -> float:
        """Return the distance from the center to the beam's end: the whole end is on the border.

        The beam is shortened if its corners would leave the terrain.
        """
        reaches = []
        for side, along, across in (
            (self.size[0], abs(math.cos(angle)), abs(math.sin(angle))),
            (self.size[1], abs(math.sin(angle)), abs(math.cos(angle))),
        ):
            onto_border = side / 2 - self.border_width + width / 2 * across
            within = side / 2 - width / 2 * across
            reaches.append(min(onto_border, within) / max(along, 1e-9))
        return min(reaches)


@dataclass(kw_only=True)
class BoxNestedRingsTerrainCfg(SubTerrainCfg):
    """Nested square rings over a pit, with gaps between them.

    Difficulty decreases the ring width and increases the gaps.
    """

    num_rings: int = 5
    """Maximum number of rings. Fewer if rings reach the platform size."""
    ring_width_range: tuple[float, float] = (0.3, 0.6)
    """Ring width at difficulty 1 and 0 (m)."""
    gap_range: tuple[float, float] = (0.0, 0.2)
    """Gap between rings at difficulty 0 and 1 (m)."""
    height_range: tuple[float, float] = (0.1, 0.4)
    """Range whose mean is the height of all tops, at every difficulty (m)."""
    platform_width: float = 1.0
    """Minimum extent of rings (m). A pad fills the remaining center."""
    border_width: float = 0.25
    """Width of the border (m)."""
    floor_depth: float = 2.0
    """Pit depth (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; see `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        width = lerp(self.ring_width_range[::-1], difficulty)
        gap = lerp(self.gap_range, difficulty)
        dark, bottom, top = border_color(BLUE), -self.floor_depth, sum(self.height_range) / 2
        boxes.add_pit(self.border_width, top, dark, self.floor_depth)
        outer, ring = inset(self.size, self.border_width), 0
        while ring < self.num_rings and min(outer) > self.platform_width:
            shade = brand_ramp(BLUE, ring / max(self.num_rings - 1, 1))
            boxes.add_ring(outer, width, top, shade, bottom=bottom, order="-y +y -x +x")
            outer, ring = inset(outer, width + gap), ring + 1
        pad = max(outer[0] + 2.0 * gap, 0.01), max(outer[1] + 2.0 * gap, 0.01)
        boxes.add_platform(pad, top, dark, bottom=bottom)
        return boxes.output(top)
