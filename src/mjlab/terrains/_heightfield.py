"""What all height fields share: their checks, their pixels, and the MuJoCo field with its texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjlab.sim.memory import available_memory
from mjlab.terrains._fields import refuse_unless, refuse_unless_positive
from mjlab.terrains._flat_patches import check_flat_patch, find_flat_patches_from_heightfield
from mjlab.terrains._height_texture import color_by_height
from mjlab.terrains._names import asset_name
from mjlab.terrains.terrain_generator import SubTerrainCfg, TerrainGeometry, TerrainOutput

# A thin sheet lets fast or deep contacts through to the other side.
MIN_BASE_THICKNESS = 0.5
# How far around the centre a robot may be placed, and how far it may reach.
SPAWN_RADIUS = 1.0
# A mistyped pixel size should be told, rather than fill the memory.
_MAX_PIXELS = 10_000_000
# Bytes of a pixel, at least: its height in the spec, in the model and in the host data's model, and color.
_BYTES_PER_PIXEL = 14


@dataclass(frozen=True)
class Pixels:
    """How a sub-terrain is divided into pixels. Arrays are indexed [row, col]: rows run along y."""

    rows: int
    """Number of pixels along y, border included."""
    cols: int
    """Number of pixels along x, border included."""
    border: int
    """Width of the border, which stays at height 0, in pixels."""
    inner_size: tuple[float, float]
    """Extent of the ground inside the border along x and y, in metres."""

    @property
    def inner(self) -> tuple[int, int]:
        """Number of rows and columns inside the border."""
        return self.rows - 2 * self.border, self.cols - 2 * self.border

    def with_border(self, inner: np.ndarray) -> np.ndarray:
        """Return heights of the whole field, from (rows, cols) ones inside the border."""
        return np.pad(inner, self.border)


def divide_into_pixels(cfg: SubTerrainCfg, pixel_field: str = "horizontal_scale") -> Pixels:
    """Divide `cfg.size` into pixels of the size in the given field of the config.

    The number of columns comes from the x size and that of rows from the y size, both truncated.

    Raises:
        ValueError: pixels or border do not fit the size.
    """
    refuse_unless_positive(cfg, pixel_field)
    pixel, border_width = getattr(cfg, pixel_field), getattr(cfg, "border_width")  # noqa: B009
    refuse_unless(
        border_width == 0.0 or border_width >= pixel,
        cfg,
        "border_width",
        f"it must be 0, or at least one pixel ({pixel_field} = {pixel:g} m).",
    )
    refuse_unless(
        all(extent / pixel <= _MAX_PIXELS for extent in cfg.size),
        cfg,
        pixel_field,
        f"expected at most {_MAX_PIXELS:,} pixels of {tuple(cfg.size)} m. Use larger ones.",
    )
    border = int(border_width / pixel)
    cols, rows = (int(extent / pixel) for extent in cfg.size)
    refuse_unless(
        min(rows, cols) - 2 * border >= 2,
        cfg,
        "size",
        f"with {pixel_field} = {pixel:g} and border_width = {border_width:g} that leaves less than "
        "2 x 2 pixels of ground. Make it larger, or the pixels or the border smaller.",
    )
    refuse_unless(
        rows * cols <= _MAX_PIXELS,
        cfg,
        pixel_field,
        f"that makes {rows * cols:,} pixels of {tuple(cfg.size)} m. Use larger ones; at most "
        f"{_MAX_PIXELS:,} are allowed.",
    )
    if border == 0:
        return Pixels(rows, cols, 0, (cfg.size[0], cfg.size[1]))
    inner_size = ((cols - 2 * border) * pixel, (rows - 2 * border) * pixel)
    return Pixels(rows, cols, border, inner_size)


def refuse_unless_platform_fits(cfg: Any) -> None:
    """Raise `ValueError` unless the platform fits inside the border."""
    room = min(cfg.size) - 2.0 * cfg.border_width
    refuse_unless(
        0.0 <= cfg.platform_width <= room,
        cfg,
        "platform_width",
        f"it must be from 0 to {room:g} m, which is what the border leaves of the size "
        f"{tuple(cfg.size)}.",
    )


@dataclass(frozen=True)
class Heightfield:
    """A height field in a spec, and the surface that it shows."""

    hfield: mujoco.MjsHField
    geom: mujoco.MjsGeom
    surface: np.ndarray
    """(rows, cols) heights of the vertices, in metres; z of the world."""
    size: tuple[float, float]
    """Extent along x and y, in metres. Vertices are at multiples of size / (n - 1)."""

    def highest_near_centre(self, radius: float = SPAWN_RADIUS) -> float:
        """Return the highest vertex within `radius` of the centre, in metres."""
        y, x = (
            np.linspace(-extent / 2, extent / 2, count)
            for extent, count in zip(self.size[::-1], self.surface.shape, strict=True)
        )
        squared = y[:, None] ** 2 + x[None, :] ** 2
        # On a field with fewer vertices than that, the ones around the centre count.
        return float(self.surface[squared <= max(radius**2, squared.min() + 1e-9)].max())


def add_heightfield(
    spec: mujoco.MjSpec,
    size: tuple[float, float],
    surface: np.ndarray,
    thickness_ratio: float,
    flat_elevation: float,
) -> Heightfield:
    """Add a height field whose surface is exactly `surface` to the body `terrain` of the spec.

    MuJoCo stores elevations from 0 to 1, with rows along +y and columns along +x; vertices are
    `size / (n - 1)` apart. The geom is centred at half the size, at the height of the lowest
    vertex. Below that is a base of `thickness_ratio` times the elevation, at least 0.5 m.

    Args:
        spec: Where to add it.
        size: Extent along x and y, in metres.
        surface: (rows, cols) heights in metres, [row, col].
        thickness_ratio: Thickness of the base over the elevation.
        flat_elevation: The elevation that a flat field states, in metres; MuJoCo refuses 0.
    """
    # Each sub-terrain has a field of its own, and a picture of it.
    pixels = surface.size + sum(field.nrow * field.ncol for field in spec.hfields)
    memory = available_memory("cpu")
    if memory is not None and pixels * _BYTES_PER_PIXEL > memory:
        raise ValueError(
            f"Height fields: expected at most {memory // _BYTES_PER_PIXEL:,} pixels, which is what "
            f"{memory / 1e9:.1f} GB of memory can hold, got {pixels:,} so far; use a larger "
            "horizontal_scale, or fewer sub-terrains."
        )
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
    """Add a field of whole multiples of `vertical_scale`."""
    return add_heightfield(
        spec, cfg.size, noise * cfg.vertical_scale, cfg.base_thickness_ratio, cfg.vertical_scale
    )


def check_heightfield(cfg: SubTerrainCfg, *scales: str) -> None:
    """Check what all height fields have. `scales` are fields that have to be positive."""
    refuse_unless_positive(cfg, "horizontal_scale", "base_thickness_ratio", *scales)
    for name, patch in (cfg.flat_patch_sampling or {}).items():
        check_flat_patch(name, patch, cfg.size)


def finish(
    cfg: Any,
    field: Heightfield,
    spawn_height: float,
    rng: np.random.Generator,
    pixel: float | None = None,
) -> TerrainOutput:
    """Return a field and its spawn point, and draw its flat patches."""
    low = float(field.surface.min())
    patches = {
        name: find_flat_patches_from_heightfield(
            field.surface - low, pixel or cfg.horizontal_scale, low, patch, rng, size=field.size
        )
        for name, patch in (cfg.flat_patch_sampling or {}).items()
    }
    return TerrainOutput(
        origin=np.array([field.size[0] / 2, field.size[1] / 2, spawn_height]),
        # It keeps the colours of its texture.
        geometries=[TerrainGeometry(geom=field.geom, hfield=field.hfield)],
        flat_patches=patches or None,
    )
