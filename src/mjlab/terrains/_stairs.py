"""Sub-terrains of stairs, which rise or fall in square rings towards a platform in the middle."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains._boxes import BLUE, MIN_THICKNESS, RED, RGBA, Boxes, frame_color, inset
from mjlab.terrains._fields import lerp, refuse_unless, refuse_unless_positive
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput
from mjlab.utils.color import brand_ramp


def _count_steps(inner: tuple[float, float], platform: float, step_width: float) -> int:
    """Return how many rings of steps fit between the frame and the platform."""
    return max(0, min(int((side - platform) / (2.0 * step_width)) for side in inner))


def _shade(base: tuple[float, float, float], step: int, count: int) -> RGBA:
    return brand_ramp(base, step / max(count - 1, 1))


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
        refuse_unless_positive(self, "step_width")
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
        refuse_unless_positive(self, "step_thickness")
        refuse_unless(min(self.step_width_range) > 0.0, self, "step_width_range", "above 0")
        boxes = Boxes(spec, self.size)
        height = lerp(self.step_height_range, difficulty)
        width = lerp(self.step_width_range[::-1], difficulty)
        inner = inset(self.size, self.border_width)
        count = _count_steps(inner, self.platform_width, width)
        boxes.add_frame(self.border_width, 0.0, frame_color(BLUE), bottom=-height)
        for step in range(count):
            boxes.add_ring(
                inset(inner, step * width), width, self._top(step, height),
                _shade(BLUE, step, count), slab=self.step_thickness,
            )  # fmt: skip
        top = self._top(count, height)
        boxes.add(
            boxes.center, inset(inner, count * width), top, brand_ramp(BLUE, 1.0),
            slab=self.step_thickness,
        )  # fmt: skip
        return boxes.output(top)

    def _top(self, step: int, height: float) -> float:
        return -step * height if self.inverted else (step + 1) * height


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
        refuse_unless_positive(self, "step_width")
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
