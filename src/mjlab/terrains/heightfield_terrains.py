"""Sub-terrains made of one height field.

Heights are whole multiples of `vertical_scale` (Perlin noise excepted) on pixels of
`horizontal_scale`; the border stays at height 0. Rows of a field run along y and columns along x.
Each is authored with its low corner at the origin, and z is that of the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.compat import older_names
from mjlab.terrains._field_obstacles import (
    HfDiscreteObstaclesTerrainCfg as HfDiscreteObstaclesTerrainCfg,
)
from mjlab.terrains._fields import (
    lerp,
    refuse_unless,
    refuse_unless_positive,
    refuse_unless_range,
)
from mjlab.terrains._height_texture import color_by_height as color_by_height
from mjlab.terrains._heightfield import (
    add_heightfield,
    add_noise,
    check_heightfield,
    divide_into_pixels,
    finish,
    refuse_unless_platform_fits,
)
from mjlab.terrains._perlin import fractal_noise
from mjlab.terrains._resample import interpolate_cubic
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainOutput

# A field of Perlin noise is at least this high, in metres.
_MIN_PERLIN_HEIGHT = 0.001


@dataclass(kw_only=True)
class HfPyramidSlopedTerrainCfg(SubTerrainCfg):
    """A hill with a flat top, or, inverted, a hollow with a flat bottom."""

    slope_range: tuple[float, float]
    """Rise over run along the centre lines, at difficulty 0 and 1."""
    platform_width: float = 1.0
    """Side of the flat square at the centre, in metres."""
    inverted: bool = False
    """Whether it goes down instead of up."""
    border_width: float = 0.0
    """Width of the flat border, in metres: 0, or at least one pixel."""
    horizontal_scale: float = 0.1
    """Size of a pixel, in metres."""
    vertical_scale: float = 0.005
    """Step of heights, in metres."""
    base_thickness_ratio: float = 1.0
    """Thickness under the lowest point over the difference of heights; at least 0.5 m."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; robots start on the platform.

        Heights are `peak a(x) a(y)` with `a(x) = (c - |c - x|) / c`, c half the number of pixels,
        cut off where the platform begins.
        """
        check_heightfield(self, "vertical_scale")
        pixels = divide_into_pixels(self)
        refuse_unless_range(self, "slope_range")
        refuse_unless_platform_fits(self)
        slope = lerp(self.slope_range, difficulty) * (-1.0 if self.inverted else 1.0)
        peak = int(slope * pixels.inner_size[0] / 2 / self.vertical_scale)
        ramp_y, ramp_x = (_ramp(count) for count in pixels.inner)
        raw = peak * ramp_y[:, None] * ramp_x[None, :]
        half = int(self.platform_width / self.horizontal_scale / 2)
        row, col = (max(count // 2 - half, 0) for count in pixels.inner)
        cut = raw[row, col]
        raw = np.clip(raw, min(cut, 0.0), max(cut, 0.0))
        noise = pixels.with_border(np.rint(raw).astype(int))
        field = add_noise(self, spec, noise)
        centre = field.surface[pixels.rows // 2, pixels.cols // 2]
        return finish(self, field, float(centre), rng)


def _ramp(count: int) -> np.ndarray:
    """Return a tent of `count` numbers, 0 at the start and 1 in the middle."""
    middle = count // 2
    return (middle - np.abs(middle - np.arange(count))) / middle


@dataclass(kw_only=True)
class HfRandomUniformTerrainCfg(SubTerrainCfg):
    """Rough ground: random heights, interpolated if they are drawn more coarsely than pixels."""

    noise_range: tuple[float, float]
    """Lowest and highest height, in metres."""
    noise_step: float = 0.005
    """Step between possible heights, in metres; at least `vertical_scale`."""
    downsampled_scale: float | None = None
    """Distance between drawn heights, in metres, at least a pixel; None for one at each pixel."""
    horizontal_scale: float = 0.1
    """Size of a pixel, in metres."""
    vertical_scale: float = 0.005
    """Step of heights, in metres."""
    base_thickness_ratio: float = 1.0
    """Thickness under the lowest point over the difference of heights; at least 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border, in metres: 0, or at least one pixel."""
    scale_with_difficulty: bool = False
    """Whether the range is multiplied by the difficulty, which otherwise changes nothing."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; robots start at the height of the highest ground within 1 m."""
        check_heightfield(self, "vertical_scale")
        pixels = divide_into_pixels(self)
        refuse_unless_range(self, "noise_range")
        step = self._checked_step()
        spacing = self._checked_spacing(pixels.inner_size)
        factor = difficulty if self.scale_with_difficulty else 1.0
        low, high = (int(factor * end / self.vertical_scale) for end in self.noise_range)
        # The first axis is the row, that is y.
        counts = [int(extent / spacing) for extent in pixels.inner_size[::-1]]
        drawn = rng.choice(np.arange(low, high + step, step), size=counts)
        noise = pixels.with_border(interpolate_cubic(drawn, pixels.inner))
        field = add_noise(self, spec, noise)
        return finish(self, field, field.highest_near_centre(), rng)

    def _checked_step(self) -> int:
        """Return the step of noise in units of `vertical_scale`."""
        refuse_unless_positive(self, "noise_step")
        step = int(self.noise_step / self.vertical_scale)
        refuse_unless(
            step >= 1, self, "noise_step", f"it must be at least vertical_scale = "
            f"{self.vertical_scale:g} m, the step of heights.",
        )  # fmt: skip
        return step

    def _checked_spacing(self, inner_size: tuple[float, float]) -> float:
        """Return the distance between drawn heights."""
        if self.downsampled_scale is None:
            return self.horizontal_scale
        refuse_unless(
            self.downsampled_scale >= self.horizontal_scale,
            self,
            "downsampled_scale",
            f"it must not be below horizontal_scale = {self.horizontal_scale:g}.",
        )
        refuse_unless(
            2 * self.downsampled_scale <= min(inner_size),
            self,
            "downsampled_scale",
            f"that is less than two heights along the {min(inner_size):g} m inside the border.",
        )
        return self.downsampled_scale


@dataclass(kw_only=True)
class HfWaveTerrainCfg(SubTerrainCfg):
    """Waves along both axes, added up."""

    amplitude_range: tuple[float, float]
    """Twice the amplitude of each of the two waves at difficulty 0 and 1, in metres: half of the
    difference between the highest and the lowest point."""
    num_waves: int = 1
    """Number of waves along y inside the border; along x the wavelength is the same."""
    horizontal_scale: float = 0.1
    """Size of a pixel, in metres."""
    vertical_scale: float = 0.005
    """Step of heights, in metres."""
    base_thickness_ratio: float = 0.25
    """Thickness under the lowest point over the difference of heights; at least 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border, in metres: 0, or at least one pixel."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; robots start at the height of the highest ground within 1 m.

        Heights are `A (cos(2 pi n col / L) + sin(2 pi n row / L))` with L the number of rows inside
        the border and A half the amplitude.
        """
        check_heightfield(self, "vertical_scale")
        pixels = divide_into_pixels(self)
        refuse_unless_range(self, "amplitude_range", lowest=0.0)
        refuse_unless(self.num_waves > 0, self, "num_waves", "it must be at least 1.")
        refuse_unless(
            2 * self.num_waves <= pixels.inner[0],
            self,
            "num_waves",
            f"{pixels.inner[0]} pixels along y can show at most {pixels.inner[0] // 2}.",
        )
        amplitude = int(0.5 * lerp(self.amplitude_range, difficulty) / self.vertical_scale)
        rows, cols = pixels.inner
        turn = 2.0 * np.pi * self.num_waves / rows
        raw = np.sin(turn * np.arange(rows))[:, None] + np.cos(turn * np.arange(cols))[None, :]
        noise = pixels.with_border(np.rint(amplitude * raw).astype(int))
        field = add_noise(self, spec, noise)
        return finish(self, field, field.highest_near_centre(), rng)


@dataclass(kw_only=True)
class HfPerlinNoiseTerrainCfg(SubTerrainCfg):
    """Smooth hills of several sizes: fractal Perlin noise."""

    height_range: tuple[float, float]
    """Height of the highest point over the lowest at difficulty 0 and 1, in metres."""
    octaves: int = 4
    """Number of layers of noise, each finer and weaker than the one before."""
    persistence: float = 0.5
    """How much weaker each layer is, as a factor."""
    lacunarity: float = 2.0
    """How much finer each layer is, as a factor."""
    scale: float = 10.0
    """Number of hills of the first layer along each side, times horizontal_scale / resolution."""
    horizontal_scale: float = 0.1
    """Size that `scale` refers to, in metres."""
    resolution: float = 0.05
    """Size of a pixel, in metres."""
    base_thickness_ratio: float = 1.0
    """Thickness under the lowest point over the difference of heights; at least 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border, in metres: 0, or at least one pixel."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain; robots start at the height of the highest ground within 1 m."""
        check_heightfield(self, "scale", "lacunarity", "resolution")
        refuse_unless(self.octaves >= 1, self, "octaves", "it must be at least 1.")
        refuse_unless(self.persistence >= 0.0, self, "persistence", "it must not be negative.")
        refuse_unless_range(self, "height_range", lowest=0.0)
        pixels = divide_into_pixels(self, "resolution")
        frequency = self.scale * self.resolution / self.horizontal_scale
        refuse_unless(
            2 * frequency <= min(pixels.inner),
            self,
            "scale",
            f"that makes {frequency:g} hills along each side, but {min(pixels.inner)} pixels can "
            f"show at most {min(pixels.inner) // 2}.",
        )
        noise = fractal_noise(
            pixels.inner, frequency, self.octaves, self.persistence, self.lacunarity, rng
        )
        height = max(lerp(self.height_range, difficulty), _MIN_PERLIN_HEIGHT)
        surface = pixels.with_border(noise) * height
        field = add_heightfield(spec, self.size, surface, self.base_thickness_ratio, height)
        return finish(self, field, field.highest_near_centre(), rng, pixel=self.resolution)


__getattr__ = older_names(__name__)
