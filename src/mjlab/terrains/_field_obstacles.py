"""A height field with blocks and pits. Its public home is `heightfield_terrains`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from mjlab.terrains._fields import lerp, refuse_unless, refuse_unless_range
from mjlab.terrains._heightfield import (
    add_noise,
    check_heightfield,
    divide_into_pixels,
    finish,
    refuse_unless_platform_fits,
)
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput

# Obstacles stand, and their footprints grow, in steps of this many pixels.
_OBSTACLE_STEP = 4


@dataclass(kw_only=True)
class HfDiscreteObstaclesTerrainCfg(SubTerrainCfg):
    """Blocks and pits of random sizes at random places."""

    obstacle_height_mode: Literal["choice", "fixed"] = "choice"
    """`fixed` gives every obstacle the full height; `choice` draws from the full and half height,
    up and down."""
    obstacle_width_range: tuple[float, float]
    """Smallest and largest side of an obstacle, in metres."""
    obstacle_height_range: tuple[float, float]
    """Full height of obstacles at difficulty 0 and 1, in metres."""
    num_obstacles: int
    """Number of obstacles; later ones overwrite earlier ones."""
    platform_width: float = 1.0
    """Side of the square at the centre that is cleared, in metres."""
    horizontal_scale: float = 0.1
    """Size of a pixel, in metres."""
    vertical_scale: float = 0.005
    """Step of heights, in metres."""
    base_thickness_ratio: float = 1.0
    """Thickness under the lowest point over the difference of heights; at least 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border, in metres: 0, or at least one pixel."""
    square_obstacles: bool = False
    """Whether obstacles are as long as they are wide."""
    origin_z_offset: float = 0.0
    """How far above the platform robots start, in metres."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; robots start on the platform.

        Obstacles begin at every fourth pixel inside the border, and are cut off where it ends.
        """
        self._check_obstacles()
        pixels = divide_into_pixels(self)
        refuse_unless_platform_fits(self)
        full = int(lerp(self.obstacle_height_range, difficulty) / self.vertical_scale)
        heights = [full] if self.obstacle_height_mode == "fixed" else _levels(full)
        narrow, wide = (int(width / self.horizontal_scale) for width in self.obstacle_width_range)
        sides = np.arange(narrow, wide + 1, _OBSTACLE_STEP)
        inner = np.zeros(pixels.inner, dtype=int)
        starts = [np.arange(0, count, _OBSTACLE_STEP) for count in pixels.inner]
        for _ in range(self.num_obstacles):
            height, width = rng.choice(heights), rng.choice(sides)
            length = width if self.square_obstacles else rng.choice(sides)
            row, col = (rng.choice(start) for start in starts)
            inner[row : row + width, col : col + length] = height
        noise = pixels.with_border(inner)
        half = int(self.platform_width / self.horizontal_scale) // 2
        row, col = pixels.rows // 2, pixels.cols // 2
        noise[row - half : row + half, col - half : col + half] = 0
        field = add_noise(self, spec, noise)
        # Without a platform robots stand on whatever there is at the centre.
        around = max(half, 1)
        ground = field.surface[row - around : row + around, col - around : col + around].max()
        return finish(self, field, float(ground) + self.origin_z_offset, rng)

    def _check_obstacles(self) -> None:
        """Raise `ValueError` for obstacles that cannot be made."""
        check_heightfield(self, "vertical_scale")
        refuse_unless(
            self.obstacle_height_mode in ("choice", "fixed"),
            self,
            "obstacle_height_mode",
            "it must be 'choice' or 'fixed'.",
        )
        refuse_unless_range(self, "obstacle_width_range", lowest=self.horizontal_scale)
        refuse_unless_range(self, "obstacle_height_range", lowest=0.0)
        refuse_unless(self.num_obstacles >= 0, self, "num_obstacles", "it must not be negative.")


def _levels(full: int) -> list[int]:
    """Return what `choice` draws from, in units of `vertical_scale`."""
    return [-full, -full // 2, full // 2, full]
