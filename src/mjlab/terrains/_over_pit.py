"""Sub-terrains over a pit: stepping stones, beams, and nested rings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains._boxes import BLUE, GREEN, Boxes, frame_color, inset
from mjlab.terrains._fields import (
    lerp,
    refuse_unless,
    refuse_unless_positive,
    refuse_unless_range,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput
from mjlab.utils.color import brand_ramp

# Stones that the frame leaves less than this are dropped, in metres.
_MIN_STONE = 0.05
# Beams shorter than this are dropped, in metres: the platform reaches the frame there.
_MIN_BEAM = 0.01


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
        refuse_unless_positive(self, "floor_depth")
        refuse_unless_range(self, "stone_size_range", lowest=0.0)
        refuse_unless(self.stone_size_range[1] > 0.0, self, "stone_size_range", "above 0")
        boxes = Boxes(spec, self.size)
        side = lerp(self.stone_size_range[::-1], difficulty)
        inner = np.array(inset(self.size, self.border_width))
        pitch_least = self.stone_size_range[1] + self.stone_distance_range[0]
        refuse_unless(pitch_least > 0.0, self, "stone_distance_range", "stones overlap.")
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
        refuse_unless_positive(self, "floor_depth")
        refuse_unless_range(self, "beam_width_range", lowest=0.0)
        refuse_unless(self.beam_width_range[0] > 0.0, self, "beam_width_range", "above 0")
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
        refuse_unless_positive(self, "floor_depth")
        refuse_unless_range(self, "ring_width_range", lowest=0.0)
        refuse_unless(self.ring_width_range[0] > 0.0, self, "ring_width_range", "above 0")
        refuse_unless_range(self, "gap_range", lowest=0.0)
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
