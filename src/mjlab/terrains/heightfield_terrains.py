"""Height field sub-terrains: one height field each.

Heights are integer multiples of `vertical_scale` (except Perlin noise) on pixels of
`horizontal_scale`; the border has height 0. Rows of a field run along y and columns along x.
The low corner of each sub-terrain is at its origin, and z is world z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.compat import older_names
from mjlab.terrains.terrain_generator import (
    SubTerrainCfg,
    TerrainGeometry,
    TerrainOutput,
    asset_name,
)
from mjlab.terrains.utils import (
    find_flat_patches_from_heightfield,
    interpolate_cubic,
    lerp,
    resample_linear,
)
from mjlab.utils.errors import check_field
from mjlab.utils.memory import check_memory

# A thin sheet lets fast or deep contacts through to the other side.
MIN_BASE_THICKNESS = 0.5

# Minimum bytes per pixel: heights in the spec, the model and the host data's model, and color.
_BYTES_PER_PIXEL = 14

# Radius around the center of the area robots start in and touch (m).
SPAWN_RADIUS = 1.0

# Step of obstacle positions and side lengths (pixels).
_OBSTACLE_STEP = 4

# Minimum height of a Perlin noise field (m).
_MIN_PERLIN_HEIGHT = 0.001

# Gradients by the last two bits of a hash: x + y, x - y, -x + y, -x - y.
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])

# Colors saturate at this height above or below z = 0 (m).
_FULL_COLOR_HEIGHT = 0.75

# Hue at z = 0: green. Hues turn to red above and to blue below.
_GROUND_HUE = 0.33


@dataclass(kw_only=True)
class HfDiscreteObstaclesTerrainCfg(SubTerrainCfg):
    """Blocks and pits of random size at random places."""

    obstacle_height_mode: Literal["choice", "fixed"] = "choice"
    """Height of obstacles: `fixed` (full height), or `choice` (random: full or half height, up or
    down)."""
    obstacle_width_range: tuple[float, float]
    """Minimum and maximum side length of obstacles (m)."""
    obstacle_height_range: tuple[float, float]
    """Full obstacle height at difficulty 0 and 1 (m)."""
    num_obstacles: int
    """Number of obstacles. Later obstacles overwrite earlier ones."""
    platform_width: float = 1.0
    """Side length of the flat square at the center (m)."""
    horizontal_scale: float = 0.1
    """Pixel size (m)."""
    vertical_scale: float = 0.005
    """Height resolution (m)."""
    base_thickness_ratio: float = 1.0
    """Base thickness below the lowest point / height difference. Minimum thickness: 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border (m). 0, or at least one pixel."""
    square_obstacles: bool = False
    """Use obstacles with equal length and width."""
    origin_z_offset: float = 0.0
    """Height of the spawn point above the platform (m)."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain, with the spawn point on the platform.

        Obstacles start at every fourth pixel inside the border, and are clipped at the border.
        """
        pixels = divide_into_pixels(self.size, self.horizontal_scale, self.border_width)
        full = int(lerp(self.obstacle_height_range, difficulty) / self.vertical_scale)
        is_choice = self.obstacle_height_mode == "choice"
        heights = [-full, -full // 2, full // 2, full] if is_choice else [full]
        narrow, wide = sorted(
            max(int(width / self.horizontal_scale), 0) for width in self.obstacle_width_range
        )
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
        half = min(half, row, col)
        noise[row - half : row + half, col - half : col + half] = 0
        field = add_noise(self, spec, noise)
        # Without a platform robots stand on the obstacles at the center.
        around = max(half, 1)
        ground = field.surface[row - around : row + around, col - around : col + around].max()
        return finish(self, field, float(ground) + self.origin_z_offset, rng)


@dataclass(kw_only=True)
class HfPyramidSlopedTerrainCfg(SubTerrainCfg):
    """Pyramidal hill with a flat top, or, inverted, a hollow with a flat bottom."""

    slope_range: tuple[float, float]
    """Slope (rise / run) along the center lines at difficulty 0 and 1."""
    platform_width: float = 1.0
    """Side length of the flat square at the center (m)."""
    inverted: bool = False
    """Slope down to the platform instead of up."""
    border_width: float = 0.0
    """Width of the flat border (m). 0, or at least one pixel."""
    horizontal_scale: float = 0.1
    """Pixel size (m)."""
    vertical_scale: float = 0.005
    """Height resolution (m)."""
    base_thickness_ratio: float = 1.0
    """Base thickness below the lowest point / height difference. Minimum thickness: 0.5 m."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain, with the spawn point on the platform.

        Heights are `peak a(x) a(y)` with `a(x) = (c - |c - x|) / c`, c half the number of pixels,
        clipped at the height of the platform's edge.
        """
        pixels = divide_into_pixels(self.size, self.horizontal_scale, self.border_width)
        slope = lerp(self.slope_range, difficulty) * (-1.0 if self.inverted else 1.0)
        peak = int(slope * pixels.inner_size[0] / 2 / self.vertical_scale)
        # Triangles: 0 at the start and 1 at the center.
        middles = [(count // 2, np.arange(count)) for count in pixels.inner]
        ramp_y, ramp_x = ((middle - np.abs(middle - k)) / middle for middle, k in middles)
        raw = peak * ramp_y[:, None] * ramp_x[None, :]
        half = int(self.platform_width / self.horizontal_scale / 2)
        row, col = (max(count // 2 - half, 0) for count in pixels.inner)
        cut = raw[row, col]
        raw = np.clip(raw, min(cut, 0.0), max(cut, 0.0))
        field = add_noise(self, spec, pixels.with_border(np.rint(raw).astype(int)))
        center = field.surface[pixels.rows // 2, pixels.cols // 2]
        return finish(self, field, float(center), rng)


@dataclass(kw_only=True)
class HfRandomUniformTerrainCfg(SubTerrainCfg):
    """Rough ground: random heights, interpolated if sampled more coarsely than pixels."""

    noise_range: tuple[float, float]
    """Lowest and highest height (m)."""
    noise_step: float = 0.005
    """Step between possible heights (m). At least `vertical_scale`."""
    downsampled_scale: float | None = None
    """Distance between sampled heights (m), at least one pixel. None: every pixel."""
    horizontal_scale: float = 0.1
    """Pixel size (m)."""
    vertical_scale: float = 0.005
    """Height resolution (m)."""
    base_thickness_ratio: float = 1.0
    """Base thickness below the lowest point / height difference. Minimum thickness: 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border (m). 0, or at least one pixel."""
    scale_with_difficulty: bool = False
    """Scale `noise_range` by the difficulty. Otherwise the difficulty has no effect."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain, with the spawn point at the maximum height within 1 m."""
        pixels = divide_into_pixels(self.size, self.horizontal_scale, self.border_width)
        step = int(self.noise_step / self.vertical_scale)
        check_field(self, "noise_step", step != 0, f">= vertical_scale = {self.vertical_scale:g} m")
        coarse = self.downsampled_scale
        spacing = self.horizontal_scale if coarse is None else coarse
        factor = difficulty if self.scale_with_difficulty else 1.0
        low, high = (int(factor * end / self.vertical_scale) for end in self.noise_range)
        # The first axis is the row (y).
        counts = [int(extent / spacing) for extent in pixels.inner_size[::-1]]
        drawn = rng.choice(np.arange(low, high + step, step), size=counts)
        field = add_noise(self, spec, pixels.with_border(interpolate_cubic(drawn, pixels.inner)))
        return finish(self, field, field.max_height_near_center(), rng)


@dataclass(kw_only=True)
class HfWaveTerrainCfg(SubTerrainCfg):
    """Sum of waves along x and y."""

    amplitude_range: tuple[float, float]
    """Twice the amplitude of each wave at difficulty 0 and 1 (m): half of the difference between
    the highest and the lowest point."""
    num_waves: int = 1
    """Number of waves along y inside the border. Waves along x have the same wavelength."""
    horizontal_scale: float = 0.1
    """Pixel size (m)."""
    vertical_scale: float = 0.005
    """Height resolution (m)."""
    base_thickness_ratio: float = 0.25
    """Base thickness below the lowest point / height difference. Minimum thickness: 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border (m). 0, or at least one pixel."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain, with the spawn point at the maximum height within 1 m.

        Heights are `A (cos(2 pi n col / L) + sin(2 pi n row / L))` with L the number of rows inside
        the border and A half the amplitude.
        """
        pixels = divide_into_pixels(self.size, self.horizontal_scale, self.border_width)
        amplitude = int(0.5 * lerp(self.amplitude_range, difficulty) / self.vertical_scale)
        rows, cols = pixels.inner
        turn = 2.0 * np.pi * self.num_waves / rows
        raw = np.sin(turn * np.arange(rows))[:, None] + np.cos(turn * np.arange(cols))[None, :]
        noise = pixels.with_border(np.rint(amplitude * raw).astype(int))
        field = add_noise(self, spec, noise)
        return finish(self, field, field.max_height_near_center(), rng)


@dataclass(kw_only=True)
class HfPerlinNoiseTerrainCfg(SubTerrainCfg):
    """Smooth hills of several sizes (fractal Perlin noise)."""

    height_range: tuple[float, float]
    """Height difference between highest and lowest point at difficulty 0 and 1 (m)."""
    octaves: int = 4
    """Number of octaves, each with higher frequency and lower amplitude."""
    persistence: float = 0.5
    """Amplitude factor between successive octaves."""
    lacunarity: float = 2.0
    """Frequency factor between successive octaves."""
    scale: float = 10.0
    """Number of hills of the first octave along each side, times horizontal_scale / resolution."""
    horizontal_scale: float = 0.1
    """Reference length of `scale` (m)."""
    resolution: float = 0.05
    """Pixel size (m)."""
    base_thickness_ratio: float = 1.0
    """Base thickness below the lowest point / height difference. Minimum thickness: 0.5 m."""
    border_width: float = 0.0
    """Width of the flat border (m). 0, or at least one pixel."""

    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the terrain, with the spawn point at the maximum height within 1 m."""
        pixels = divide_into_pixels(self.size, self.resolution, self.border_width)
        frequency = self.scale * self.resolution / self.horizontal_scale
        noise = fractal_noise(
            pixels.inner, frequency, self.octaves, self.persistence, self.lacunarity, rng
        )
        height = max(lerp(self.height_range, difficulty), _MIN_PERLIN_HEIGHT)
        surface = pixels.with_border(noise) * height
        field = add_heightfield(spec, self.size, surface, self.base_thickness_ratio, height)
        return finish(self, field, field.max_height_near_center(), rng, pixel=self.resolution)


# Pixels.


@dataclass(frozen=True)
class Pixels:
    """Pixel grid of a sub-terrain. Arrays are indexed [row, col]; rows run along y."""

    rows: int
    """Number of pixels along y, including the border."""
    cols: int
    """Number of pixels along x, including the border."""
    border: int
    """Width of the border (pixels). The border has height 0."""
    inner_size: tuple[float, float]
    """Extent inside the border along x and y (m)."""

    @property
    def inner(self) -> tuple[int, int]:
        """Number of rows and columns inside the border, at least 2."""
        return max(self.rows - 2 * self.border, 2), max(self.cols - 2 * self.border, 2)

    def with_border(self, inner: np.ndarray) -> np.ndarray:
        """Pad heights inside the border, (rows, cols), to the whole field.

        A field without 2 x 2 pixels inside the border is flat.
        """
        if min(self.rows, self.cols) - 2 * self.border < 2:
            return np.zeros((self.rows, self.cols), inner.dtype)
        return np.pad(inner, self.border)


def divide_into_pixels(size: tuple[float, float], pixel: float, border_width: float) -> Pixels:
    """Divide a sub-terrain of `size` (m) into pixels of length `pixel` (m).

    Columns divide the x size and rows the y size, both rounded down.
    """
    cols, rows = (int(extent / pixel) for extent in size)
    check_memory(f"Pixels of {pixel:g} m", rows * cols, _BYTES_PER_PIXEL, "cpu", "larger pixels")
    border = max(int(border_width / pixel), 0)
    pixels = Pixels(rows, cols, border, (size[0], size[1]))
    if border == 0:
        return pixels
    return Pixels(rows, cols, border, (pixels.inner[1] * pixel, pixels.inner[0] * pixel))


# Fields and their colors.


@dataclass(frozen=True)
class Heightfield:
    """Height field in a spec, and its surface."""

    hfield: mujoco.MjsHField
    geom: mujoco.MjsGeom
    surface: np.ndarray
    """World z of the vertices (m), (rows, cols)."""
    size: tuple[float, float]
    """Extent along x and y (m). Vertices are at multiples of size / (n - 1)."""

    def max_height_near_center(self, radius: float = SPAWN_RADIUS) -> float:
        """Return the maximum height within `radius` of the center (m)."""
        y, x = (
            np.linspace(-extent / 2, extent / 2, count)
            for extent, count in zip(self.size[::-1], self.surface.shape, strict=True)
        )
        squared = y[:, None] ** 2 + x[None, :] ** 2
        # Coarse fields may have no vertex within the radius: use the nearest vertices.
        return float(self.surface[squared <= max(radius**2, squared.min() + 1e-9)].max())


def add_heightfield(
    spec: mujoco.MjSpec,
    size: tuple[float, float],
    surface: np.ndarray,
    thickness_ratio: float,
    flat_elevation: float,
) -> Heightfield:
    """Add a height field with this exact surface to the body `terrain` of the spec.

    MuJoCo stores elevations in [0, 1], with rows along +y and columns along +x; vertices are
    `size / (n - 1)` apart. The geom is centered at half the size, at the height of the lowest
    vertex. The base below has a thickness of `thickness_ratio` times the elevation, at least 0.5 m.

    Args:
        spec: Spec to modify.
        size: Extent along x and y (m).
        surface: (rows, cols) heights (m), [row, col].
        thickness_ratio: Thickness of the base / elevation.
        flat_elevation: Elevation of a flat field (m). MuJoCo rejects 0.
    """
    low = float(surface.min())
    span = float(surface.max()) - low
    elevation = span if span > 0.0 else flat_elevation
    name = asset_name(spec, "hfield")
    hfield = spec.add_hfield(
        name=name,
        nrow=surface.shape[0],
        ncol=surface.shape[1],
        size=(
            size[0] / 2,
            size[1] / 2,
            elevation,
            max(elevation * thickness_ratio, MIN_BASE_THICKNESS),
        ),
        userdata=((surface - low) / elevation).ravel().tolist(),
    )
    geom = spec.body("terrain").add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname=name,
        pos=(size[0] / 2, size[1] / 2, low),
        material=color_by_height(spec, surface, name, surface),
    )
    return Heightfield(hfield, geom, surface, (size[0], size[1]))


def add_noise(cfg: Any, spec: mujoco.MjSpec, noise: np.ndarray) -> Heightfield:
    """Add a height field given in integer multiples of `vertical_scale`."""
    return add_heightfield(
        spec, cfg.size, noise * cfg.vertical_scale, cfg.base_thickness_ratio, cfg.vertical_scale
    )


def finish(
    cfg: Any,
    field: Heightfield,
    spawn_height: float,
    rng: np.random.Generator,
    pixel: float | None = None,
) -> TerrainOutput:
    """Return the terrain output: geom, spawn point and sampled flat patches."""
    low = float(field.surface.min())
    patches = {
        name: find_flat_patches_from_heightfield(
            field.surface - low, pixel or cfg.horizontal_scale, low, patch, rng, size=field.size
        )
        for name, patch in (cfg.flat_patch_sampling or {}).items()
    }
    return TerrainOutput(
        origin=np.array([field.size[0] / 2, field.size[1] / 2, spawn_height]),
        # Without a color, the geom keeps the colors of its texture.
        geometries=[TerrainGeometry(geom=field.geom, hfield=field.hfield)],
        flat_patches=patches or None,
    )


def color_by_height(
    spec: mujoco.MjSpec,
    noise: np.ndarray,
    unique_id: str,
    physical_heights: np.ndarray,
    texture_size: int = 128,
) -> str:
    """Add a material with a texture colored by height, and return the material's name.

    The color scale is absolute and the same for all terrains: with `s = clip(h / 0.75, -1, 1)`, the
    hue is `0.33 (1 - s)`, saturation and value are `0.45 + 0.25 |s|`. So ground at z = 0 is green,
    hills turn red and hollows blue.

    Args:
        spec: Spec to modify.
        noise: Heights in multiples of the vertical scale. Unused: colors follow
            `physical_heights`.
        unique_id: Name of the texture and of the material.
        physical_heights: (rows, cols) heights above z = 0 (m), [row, col].
        texture_size: Width and height of the texture (pixels).
    """
    heights = resample_linear(np.asarray(physical_heights, float), (texture_size, texture_size))
    level = np.clip(heights / _FULL_COLOR_HEIGHT, -1.0, 1.0)
    vividness = 0.45 + 0.25 * np.abs(level)
    rgb = hsv_to_rgb(_GROUND_HUE * (1.0 - level), vividness, vividness)
    # Rows of a field run along +y, rows of a texture along -y.
    pixels = (rgb * 255.0).astype(np.uint8)[::-1]
    texture = spec.add_texture(
        name=unique_id,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=texture_size,
        height=texture_size,
        nchannel=3,
    )
    texture.data = pixels.tobytes()
    material = spec.add_material(name=unique_id)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = unique_id
    return unique_id


def hsv_to_rgb(hue: np.ndarray, saturation: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Convert HSV arrays of any shape S to RGB of shape (*S, 3), all in [0, 1].

    Channel n is `v - v s max(0, min(k, 4 - k, 1))` with `k = (n + 6 h) mod 6` and n = 5, 3, 1.
    """
    k = (np.array([5.0, 3.0, 1.0]) + 6.0 * hue[..., None]) % 6.0
    drop = np.clip(np.minimum(k, 4.0 - k), 0.0, 1.0)
    return (value * 1.0)[..., None] - (value * saturation)[..., None] * drop


# Noise.


def fractal_noise(
    shape: tuple[int, int],
    frequency: float,
    octaves: int,
    persistence: float,
    lacunarity: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return noise rescaled to [0, 1], (rows, cols). Constant noise: zeros.

    Octave k adds gradient noise (K. Perlin, "Improving noise", SIGGRAPH 2002) with
    `frequency * lacunarity^k` cells along each side and weight `persistence^k`.

    Args:
        shape: Number of rows and columns.
        frequency: Number of cells of the first octave along each side.
        octaves: Number of octaves.
        persistence: Amplitude factor between successive octaves.
        lacunarity: Frequency factor between successive octaves.
        rng: Source of the permutation of lattice gradients.
    """
    permutation = np.tile(rng.permutation(256), 2)
    total, weights = np.zeros(shape), 0.0
    for octave in range(octaves):
        cells, weight = frequency * lacunarity**octave, persistence**octave
        rows, cols = (np.arange(count) * cells / count for count in shape)
        total += weight * _gradient_noise(rows[:, None], cols[None, :], permutation)
        weights += weight
    total /= weights or 1.0
    low, span = total.min(), np.ptp(total)
    return (total - low) / span if span > 0.0 else np.zeros(shape)


def _gradient_noise(x: np.ndarray, y: np.ndarray, permutation: np.ndarray) -> np.ndarray:
    """Return noise at lattice coordinates x, (n, 1), and y, (1, m), from a doubled permutation."""
    x_cell, y_cell = np.floor(x).astype(int), np.floor(y).astype(int)
    x_in, y_in = x - x_cell, y - y_cell
    x_cell, y_cell = x_cell % 256, y_cell % 256
    corners = []
    for i in (0, 1):
        for j in (0, 1):
            signs = _SIGNS[permutation[permutation[x_cell + i] + y_cell + j] % 4]
            corners.append(signs[..., 0] * (x_in - i) + signs[..., 1] * (y_in - j))
    u, v = _fade(x_in), _fade(y_in)
    low = corners[0] + v * (corners[1] - corners[0])
    high = corners[2] + v * (corners[3] - corners[2])
    return low + u * (high - low)


def _fade(t: np.ndarray) -> np.ndarray:
    return t**3 * (t * (t * 6.0 - 15.0) + 10.0)


__getattr__ = older_names(__name__)
