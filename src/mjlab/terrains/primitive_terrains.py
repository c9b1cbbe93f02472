"""Sub-terrains made of boxes (and of convex columns): stairs, grids, obstacles, and over a pit."""

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
    frame_color,
    inset,
    merge_equal_cells,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput, asset_name
from mjlab.terrains.utils import lerp
from mjlab.utils.color import brand_ramp
from mjlab.utils.errors import (
    WrongStateError,
    check_field,
    check_field_range,
    check_fields_positive,
)

# What rounding errors may add to the edges of cells, in metres.
_TOLERANCE = 1e-9

# Height of frame and platform of a tilted grid, in metres.
_TILTED_HEIGHT = 0.2

# Stones that the frame leaves less than this are dropped, in metres.
_MIN_STONE = 0.05

# Beams shorter than this are dropped, in metres: the platform reaches the frame there.
_MIN_BEAM = 0.01


@dataclass(kw_only=True)
class BoxFlatTerrainCfg(SubTerrainCfg):
    """Flat ground at z = 0, at every difficulty."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        boxes = Boxes(spec, self.size)
        boxes.add_platform(self.size, 0.0, (0.5, 0.5, 0.5, 1.0), bottom=-1.0)
        return boxes.output(0.0)


# Stairs in square rings, which rise or fall towards a platform in the middle.


@dataclass(kw_only=True)
class BoxPyramidStairsTerrainCfg(SubTerrainCfg):
    """Stairs that rise from all sides to a platform.

    A harder terrain has higher steps. The platform is one step above the last.
    """

    border_width: float = 0.0
    """Width of the flat frame around the stairs, in metres."""
    step_height_range: tuple[float, float]
    """Height of a step at difficulty 0 and 1, in metres."""
    step_width: float
    """Depth of a step, in metres."""
    platform_width: float = 1.0
    """Least extent of the platform, in metres."""
    holes: bool = False
    """Whether steps are only as long as the platform is wide, with nothing at the corners."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        return self._make(difficulty, spec, BLUE, direction=1)

    def _make(
        self,
        difficulty: float,
        spec: mujoco.MjSpec,
        base: tuple[float, float, float],
        direction: int,
    ) -> TerrainOutput:
        """Make stairs that rise (direction 1) or fall (-1) towards the middle."""
        check_fields_positive(self, "step_width")
        boxes = Boxes(spec, self.size)
        height = lerp(self.step_height_range, difficulty)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, self.step_width)
        if not self.holes:
            boxes.add_frame(self.border_width, 0.0, frame_color(base), bottom=-height)
        last = direction * (count + 1) * height
        # Steps that rise reach below the ground around them, those that fall to the platform.
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
    """Stairs that fall from all sides to a platform."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        return self._make(difficulty, spec, RED, direction=-1)


@dataclass(kw_only=True)
class BoxOpenStairsTerrainCfg(SubTerrainCfg):
    """Stairs of slabs with nothing below them.

    A harder terrain has steps that are higher and not as deep.
    """

    step_height_range: tuple[float, float] = (0.1, 0.2)
    """Height of a step at difficulty 0 and 1, in metres."""
    step_width_range: tuple[float, float] = (0.4, 0.8)
    """Depth of a step at difficulty 1 and 0, in metres."""
    platform_width: float = 1.0
    """Least extent of the platform in the middle, in metres."""
    border_width: float = 0.25
    """Width of the flat frame around the stairs, in metres."""
    step_thickness: float = 0.05
    """Thickness of the slabs, in metres."""
    inverted: bool = True
    """Whether the stairs fall towards the platform. The first step is then level with the frame,
    and the platform one step below the last."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        check_fields_positive(self, "step_thickness")
        check_field(self, "step_width_range", min(self.step_width_range) > 0.0, "widths > 0")
        boxes = Boxes(spec, self.size)
        height = lerp(self.step_height_range, difficulty)
        width = lerp(self.step_width_range[::-1], difficulty)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, width)
        boxes.add_frame(self.border_width, 0.0, frame_color(BLUE), bottom=-height)
        tops = [-k * height if self.inverted else (k + 1) * height for k in range(count + 1)]
        for step in range(count):
            boxes.add_ring(
                inset(inner, step * width), width, tops[step], _shade(BLUE, step, count),
                slab=self.step_thickness,
            )  # fmt: skip
        top = tops[count]
        boxes.add(
            boxes.center, inset(inner, count * width), top, brand_ramp(BLUE, 1.0),
            slab=self.step_thickness,
        )  # fmt: skip
        return boxes.output(top)


@dataclass(kw_only=True)
class BoxRandomStairsTerrainCfg(SubTerrainCfg):
    """Stairs that rise to a platform, each step by another height.

    A harder terrain has higher steps: half of the drawn height at difficulty 0, all of it at 1.
    """

    step_width: float = 0.8
    """Depth of a step, in metres."""
    step_height_range: tuple[float, float] = (0.1, 0.3)
    """Range from which the height of each step is drawn, in metres."""
    platform_width: float = 1.0
    """Least extent of the platform in the middle, in metres. It is level with the last step."""
    border_width: float = 0.25
    """Width of the flat frame around the stairs, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        check_fields_positive(self, "step_width")
        boxes = Boxes(spec, self.size)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, self.step_width)
        boxes.add_frame(self.border_width, 0.0, frame_color(BLUE))
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
    """Return how many rings of steps fit between the frame and the platform."""
    return max(0, min(int((side - platform) / (2.0 * step_width)) for side in inner))


def _shade(base: tuple[float, float, float], step: int, count: int) -> RGBA:
    return brand_ramp(base, step / max(count - 1, 1))


# Grids of cells: level ones of random height, or tilted ones.


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
        check_field(self, "size", self.size[0] == self.size[1], "a square")
        check_field(self, "grid_height_range", min(self.grid_height_range) >= 0.0, "heights >= 0")
        check_fields_positive(self, "height_merge_threshold", "max_merge_distance")
        boxes = Boxes(spec, self.size)
        grid = _lay_out(self, boxes.center)
        if min(grid.frame) <= _TOLERANCE:
            raise WrongStateError(
                f"BoxRandomGridTerrainCfg: {grid.counts[0]} columns of grid_width "
                f"{self.grid_width} m fill the size of {self.size[0]} m and leave no frame. "
                "Give a border_width, or another grid_width."
            )
        boxes.add_frame(grid.frame, 0.0, frame_color(GREEN), bottom=-1.0)
        highest = lerp(self.grid_height_range, difficulty)
        heights = rng.uniform(-highest, highest, grid.counts)
        merge = self.merge_similar_heights and not self.holes
        if merge:
            threshold = self.height_merge_threshold
            # Rounding must not lift a column that the platform hides in part above it.
            rounded = np.round(heights / threshold) * threshold
            heights = np.clip(rounded, -highest, highest)
        kept = [
            not grid.is_under_platform(i, j) and (not self.holes or grid.is_in_cross(i, j))
            for i, j in grid.cells()
        ]
        kept = np.array(kept).reshape(grid.counts)
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
        check_fields_positive(self, "floor_depth")
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
    check_fields_positive(cfg, "grid_width")
    counts = tuple(int((side - 2.0 * cfg.border_width) / cfg.grid_width) for side in cfg.size)
    check_field(cfg, "grid_width", min(counts) >= 1, "a width of which a cell fits in the borders")
    frame = tuple(
        (side - count * cfg.grid_width) / 2 for side, count in zip(cfg.size, counts, strict=True)
    )
    return _Grid(
        cfg.grid_width, (counts[0], counts[1]), (frame[0], frame[1]), center, cfg.platform_width
    )


# Boxes on flat ground.


@dataclass(kw_only=True)
class BoxRandomSpreadTerrainCfg(SubTerrainCfg):
    """Boxes of random size, at random places and turned at random, around a free square.

    A harder terrain has more and higher boxes. Boxes that would reach into the square are left out.
    """

    num_boxes: int = 60
    """Number of boxes at difficulty 1; half of it at 0."""
    box_width_range: tuple[float, float] = (0.3, 1.0)
    """Range of a box's length along its x axis, in metres."""
    box_length_range: tuple[float, float] = (0.3, 1.0)
    """Range of a box's length along its y axis, in metres."""
    box_height_range: tuple[float, float] = (0.05, 1.0)
    """Range of a box's height at difficulty 1, in metres; a fifth of it at 0."""
    box_yaw_range: tuple[float, float] = (0.0, 360.0)
    """Range of a box's rotation about z, in degrees."""
    add_floor: bool = True
    """Whether there is ground between the boxes, instead of only a platform in the middle."""
    platform_width: float = 1.0
    """Extent of the square in the middle, in metres."""
    border_width: float = 0.25
    """Width of the flat frame around the boxes, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        for field in ("box_width_range", "box_length_range", "box_height_range"):
            check_field_range(self, field, lowest=0.0)
            check_field(self, field, getattr(self, field)[0] > 0.0, "lengths > 0")
        check_field_range(self, "box_yaw_range")
        check_field(self, "num_boxes", self.num_boxes >= 0, "a number >= 0")
        boxes = Boxes(spec, self.size)
        boxes.add_frame(self.border_width, 0.0, frame_color(BLUE), bottom=-1.0)
        inner = inset(self.size, self.border_width)
        ground = inner if self.add_floor else (self.platform_width, self.platform_width)
        boxes.add_platform(ground, 0.0, frame_color(BLUE), bottom=-1.0 * (not self.add_floor))
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
        # The draws above keep the box as it is before it turns inside the frame.
        reach = _turned_extent(length, yaw) / 2
        limit = np.maximum(np.array(inner) / 2 - reach, 0.0)
        place = np.clip(place, -limit, limit)
        if (reach > np.array(inner) / 2).any():
            return
        if _touches_square(place, length, yaw, self.platform_width):
            return
        color = brand_ramp(BLUE, float(rng.uniform(0.3, 0.8)))
        x, y = np.array(boxes.center) + place
        boxes.add(
            (float(x), float(y)), (float(length[0]), float(length[1])), top, color,
            bottom=0.0, yaw=yaw,
        )  # fmt: skip


def _turned_extent(length: np.ndarray, yaw: float) -> np.ndarray:
    """Return the (2,) extent along x and y of a rectangle that is turned by yaw."""
    cos, sin = abs(math.cos(yaw)), abs(math.sin(yaw))
    return np.array([length[0] * cos + length[1] * sin, length[0] * sin + length[1] * cos])


def _touches_square(center: np.ndarray, length: np.ndarray, yaw: float, side: float) -> bool:
    """Return whether a turned rectangle touches a square about the origin.

    Two convex shapes are apart if they are apart along an axis of one of them.
    """
    if (abs(center) > (_turned_extent(length, yaw) + side) / 2).any():
        return False
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = np.array([center[0] * cos + center[1] * sin, -center[0] * sin + center[1] * cos])
    square = _turned_extent(np.array([side, side]), yaw)
    return bool((abs(along) <= (square + length) / 2).all())


# Over a pit: stepping stones, beams, and nested rings.


@dataclass(kw_only=True)
class BoxSteppingStonesTerrainCfg(SubTerrainCfg):
    """Stones in a grid over a pit, around a platform.

    A harder terrain has smaller stones, that differ more in size, place and height.
    """

    stone_size_range: tuple[float, float] = (0.4, 0.8)
    """Extent of a stone at difficulty 1 and 0, in metres."""
    stone_distance_range: tuple[float, float] = (0.2, 0.5)
    """The first is the least gap between stones at difficulty 0, in metres; the second has no
    effect, because gaps grow as stones shrink."""
    stone_height: float = 0.2
    """Height of stones, platform and frame, in metres."""
    stone_height_variation: float = 0.1
    """Largest deviation of a stone's height at difficulty 1, in metres."""
    stone_size_variation: float = 0.1
    """Largest deviation of a stone's extents at difficulty 1, in metres."""
    floor_depth: float = 2.0
    """Depth of the pit, in metres."""
    displacement_range: float = 0.1
    """Largest displacement of a stone along x and y at difficulty 1, in metres."""
    platform_width: float = 1.0
    """Least extent of the platform in the middle, in metres."""
    border_width: float = 0.25
    """Width of the frame, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        check_fields_positive(self, "floor_depth")
        check_field_range(self, "stone_size_range", lowest=0.0)
        check_field(self, "stone_size_range", self.stone_size_range[1] > 0.0, "lengths > 0")
        boxes = Boxes(spec, self.size)
        side = lerp(self.stone_size_range[::-1], difficulty)
        inner = np.array(inset(self.size, self.border_width))
        pitch_least = self.stone_size_range[1] + self.stone_distance_range[0]
        least_gap = f"a first value > {-self.stone_size_range[1]:g}"
        check_field(self, "stone_distance_range", pitch_least > 0.0, least_gap)
        counts = np.maximum(2, np.floor(inner / pitch_least).astype(int) + 1)
        pitch = inner / (counts - 1)
        reach = self._platform_reach(side, inner, counts, pitch)
        dark, bottom = frame_color(GREEN), -self.floor_depth
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
        """Return the (2,) half extents of the platform, whose gap to the next stones is theirs."""
        gap = np.maximum(0.0, pitch - side)
        least = self.platform_width / 2
        # The first stone, along each axis, that is a gap or more beyond the least platform.
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
        """Add one stone, unless it is on the platform or the frame leaves too little of it."""
        shift, vary = self.displacement_range * difficulty, self.stone_size_variation * difficulty
        place = place + rng.uniform(-shift, shift, 2)
        half = (side + rng.uniform(-vary, vary, 2)) / 2
        if (abs(place) <= reach).all():
            return
        low, high = np.maximum(place - half, -room), np.minimum(place + half, room)
        if (high - low < _MIN_STONE).any():
            return
        rise = self.stone_height_variation * difficulty
        top = self.stone_height + float(rng.uniform(-rise, rise))
        color = brand_ramp(GREEN, float(rng.uniform(0.4, 0.7)))
        x, y = np.array(boxes.center) + (low + high) / 2
        boxes.add(
            (float(x), float(y)), (float(high[0] - low[0]), float(high[1] - low[1])), top, color,
            bottom=-self.floor_depth,
        )  # fmt: skip


@dataclass(kw_only=True)
class BoxNarrowBeamsTerrainCfg(SubTerrainCfg):
    """Beams over a pit, from a platform to the frame in all directions.

    A harder terrain has narrower beams.
    """

    num_beams: int = 16
    """Number of beams."""
    beam_width_range: tuple[float, float] = (0.2, 0.4)
    """Width of a beam at difficulty 1 and 0, in metres."""
    beam_height: float = 0.2
    """Height of beams, platform and frame, in metres."""
    spacing: float = 0.8
    """Has no effect: beams are at equal angles."""
    platform_width: float = 1.0
    """Largest extent of the platform in the middle, in metres. It is smaller where the beams would
    leave it apart."""
    border_width: float = 0.25
    """Width of the frame, in metres."""
    floor_depth: float = 2.0
    """Depth of the pit, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        check_fields_positive(self, "floor_depth")
        check_field_range(self, "beam_width_range", lowest=0.0)
        check_field(self, "beam_width_range", self.beam_width_range[0] > 0.0, "widths > 0")
        boxes = Boxes(spec, self.size)
        width = lerp(self.beam_width_range[::-1], difficulty)
        radius = self.platform_width / 2
        if self.num_beams > 1:
            chord = 2.0 * math.sqrt(2.0) * math.sin(math.pi / self.num_beams)
            radius = min(radius, width / chord)
        dark, bottom, top = frame_color(BLUE), -self.floor_depth, self.beam_height
        boxes.add_pit(self.border_width, top, dark, self.floor_depth)
        boxes.add_platform((2.0 * radius, 2.0 * radius), top, dark, bottom=bottom)
        for index in range(self.num_beams):
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
        """Return how far a beam goes from the middle: so far that its whole end is on the frame.

        It ends earlier where its corners would leave the terrain.
        """
        reaches = []
        for side, along, across in (
            (self.size[0], abs(math.cos(angle)), abs(math.sin(angle))),
            (self.size[1], abs(math.sin(angle)), abs(math.cos(angle))),
        ):
            onto_frame = side / 2 - self.border_width + width / 2 * across
            within = side / 2 - width / 2 * across
            reaches.append(min(onto_frame, within) / max(along, 1e-9))
        return min(reaches)


@dataclass(kw_only=True)
class BoxNestedRingsTerrainCfg(SubTerrainCfg):
    """Square rings over a pit, one in another, with gaps between them.

    A harder terrain has narrower rings and wider gaps.
    """

    num_rings: int = 5
    """Most rings; there are fewer if they get as small as the platform."""
    ring_width_range: tuple[float, float] = (0.3, 0.6)
    """Width of a ring at difficulty 1 and 0, in metres."""
    gap_range: tuple[float, float] = (0.0, 0.2)
    """Gap between rings at difficulty 0 and 1, in metres."""
    height_range: tuple[float, float] = (0.1, 0.4)
    """Their mean is the height of all tops, in metres, whatever the difficulty."""
    platform_width: float = 1.0
    """Rings end where one would be smaller than this, in metres; a pad fills what is left."""
    border_width: float = 0.25
    """Width of the frame, in metres."""
    floor_depth: float = 2.0
    """Depth of the pit, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """See `SubTerrainCfg.function`."""
        check_fields_positive(self, "floor_depth")
        check_field_range(self, "ring_width_range", lowest=0.0)
        check_field(self, "ring_width_range", self.ring_width_range[0] > 0.0, "widths > 0")
        check_field_range(self, "gap_range", lowest=0.0)
        boxes = Boxes(spec, self.size)
        width = lerp(self.ring_width_range[::-1], difficulty)
        gap = lerp(self.gap_range, difficulty)
        dark, bottom, top = frame_color(BLUE), -self.floor_depth, sum(self.height_range) / 2
        boxes.add_pit(self.border_width, top, dark, self.floor_depth)
        outer, ring = inset(self.size, self.border_width), 0
        while ring < self.num_rings and min(outer) > self.platform_width:
            shade = brand_ramp(BLUE, ring / max(self.num_rings - 1, 1))
            boxes.add_ring(outer, width, top, shade, bottom=bottom, order="-y +y -x +x")
            outer, ring = inset(outer, width + gap), ring + 1
        pad = max(outer[0] + 2.0 * gap, 0.01), max(outer[1] + 2.0 * gap, 0.01)
        boxes.add_platform(pad, top, dark, bottom=bottom)
        return boxes.output(top)
