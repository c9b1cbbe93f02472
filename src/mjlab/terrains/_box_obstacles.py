"""A sub-terrain of boxes that lie about on flat ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.terrains._boxes import BLUE, Boxes, frame_color, inset
from mjlab.terrains._fields import refuse_unless, refuse_unless_range
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput
from mjlab.utils.color import brand_ramp


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
        self._check()
        boxes = Boxes(spec, self.size)
        boxes.add_frame(self.border_width, 0.0, frame_color(BLUE), bottom=-1.0)
        inner = inset(self.size, self.border_width)
        ground = inner if self.add_floor else (self.platform_width, self.platform_width)
        boxes.add_platform(ground, 0.0, frame_color(BLUE), bottom=-1.0 * (not self.add_floor))
        for _ in range(int(self.num_boxes * (0.5 + 0.5 * difficulty))):
            self._add_obstacle(boxes, inner, difficulty, rng)
        return boxes.output(0.0)

    def _check(self) -> None:
        for field in ("box_width_range", "box_length_range", "box_height_range"):
            refuse_unless_range(self, field, lowest=0.0)
            refuse_unless(getattr(self, field)[0] > 0.0, self, field, "it must be above 0.")
        refuse_unless_range(self, "box_yaw_range")
        refuse_unless(self.num_boxes >= 0, self, "num_boxes", "it must not be negative.")

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
