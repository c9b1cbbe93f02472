"""Ground from a file: a mesh, or a height map.

Both become one MuJoCo height field, because MuJoCo collides a mesh as its convex hull. Contacts, rays and
pictures therefore see the same surface: the heights at the pixels, linear in between. Of a mesh it is the
top surface, without overhangs.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import mujoco
import numpy as np

from mjlab.terrains.heightfield_terrains import SPAWN_RADIUS, add_heightfield
from mjlab.utils.errors import check_field
from mjlab.utils.memory import check_memory

logger = logging.getLogger(__name__)

# Height field in the spec, the model and the host data's model, and rays.
_BYTES_PER_PIXEL = 24
# Rays start this far above a mesh (m), and at most this share of its extent inside its edges, which they
# would miss by rounding.
_ABOVE, _INSIDE = 1.0, 1e-6
_FLAT_ELEVATION = 0.01


@dataclass(kw_only=True)
class TerrainFileCfg:
    """Mesh or height map, and its placement."""

    path: str
    """Mesh (`.obj`, `.stl`, `.msh`; z is up), or height map. Of a picture (`.png`, 8 or 16 bits), up is
    +y, right is +x, and black is 0. Of an array (`.npy`, 2-D), rows run along +y and columns along +x."""
    scale: float = 1.0
    """Meters per unit: of a mesh's coordinates (0.001 for mm), of an array's heights, or from black to
    white in a picture."""
    resolution: float = 0.1
    """Pixel size (m): of the height map, or of the heights taken from the mesh."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the mesh's origin, or of the center of the height map at height 0 (m)."""
    origins: tuple[tuple[float, float], ...] | None = None
    """World x and y of environment origins (m), each for an equal share of the environments. None: a
    square grid over the ground, `SceneCfg.env_spacing` apart and as far from its edges, at most 2 m. Their
    height is that of the highest ground within 1 m."""


class Ground(NamedTuple):
    """Heights at the pixels of a ground, in the world frame."""

    heights: np.ndarray
    """World z (m), (rows, cols); rows run along +y."""
    low: np.ndarray
    """World x and y of the first pixel (m), (2,)."""
    high: np.ndarray
    """World x and y of the last pixel (m), (2,)."""

    def spawn_height(self, x: float, y: float) -> float:
        """Return the highest ground within 1 m of (x, y) (m)."""
        rows, cols = self.heights.shape
        xs = np.linspace(self.low[0], self.high[0], cols)
        ys = np.linspace(self.low[1], self.high[1], rows)
        squared = (ys[:, None] - y) ** 2 + (xs - x) ** 2
        return float(self.heights[squared <= max(SPAWN_RADIUS**2, squared.min() + 1e-9)].max())

    def spawn_points(
        self, spacing: float, places: tuple[tuple[float, float], ...] | None = None
    ) -> np.ndarray:
        """Return spawn points at `places`, or on a grid `spacing` (m) apart, (1, K, 3)."""
        if places is None:
            margin = min(spacing, 2.0)
            axes = []
            for low, high in zip(self.low, self.high, strict=True):
                count = max(1, int((high - low - 2 * margin) / spacing) + 1)
                middle, reach = (low + high) / 2, (count - 1) * spacing / 2
                axes.append(np.linspace(middle - reach, middle + reach, count))
            places = tuple((x, y) for x in axes[0] for y in axes[1])
        return np.array([[(x, y, self.spawn_height(x, y)) for x, y in places]])


def add_ground(
    spec: mujoco.MjSpec, cfg: TerrainFileCfg, kind: Literal["mesh", "heightmap"]
) -> Ground:
    """Add the ground to `spec` as the geom `terrain` of a static body `terrain`.

    Raises:
        ValueError: not a height map or mesh, or too many pixels for the memory.
    """
    check_field(cfg, "resolution", cfg.resolution > 0.0, "> 0 m")
    ground = sample_mesh(cfg) if kind == "mesh" else read_heightmap(cfg)
    missing = ~np.isfinite(ground.heights)
    if missing.any():
        check_field(cfg, "path", not missing.all(), "finite heights")
        ground.heights[missing] = ground.heights[~missing].min()
        share = 100.0 * missing.mean()
        logger.info("%s: no ground at %.3g %% of pixels; filled with the lowest.", cfg.path, share)
    spec.worldbody.add_body(name="terrain")
    size = ground.high - ground.low
    field = add_heightfield(spec, (size[0], size[1]), ground.heights, 0.0, _FLAT_ELEVATION)
    field.geom.name = "terrain"
    # The ground would dominate the model's mean mass, which scales drawings in viewers.
    field.geom.mass = 0.0
    field.geom.pos = (*((ground.low + ground.high) / 2), field.geom.pos[2])
    return ground


def read_heightmap(cfg: TerrainFileCfg) -> Ground:
    """Read a height map. Raises `ValueError` unless it is 2-D, or a picture, of at least 2 x 2 pixels."""
    suffix = Path(cfg.path).suffix.lower()
    check_field(cfg, "path", suffix in (".png", ".npy"), "a .png or .npy file for a height map")
    if suffix == ".npy":
        heights = np.load(cfg.path).astype(float)
    else:
        from matplotlib.image import imread

        picture = np.asarray(imread(cfg.path), dtype=float)
        if picture.ndim == 3:
            # Gray of color, without alpha.
            channels = picture.shape[2]
            picture = picture[..., : channels - (channels in (2, 4))].mean(axis=-1)
        heights = picture[::-1]
    is_map = heights.ndim == 2 and min(heights.shape) >= 2
    check_field(cfg, "path", is_map, f"at least 2 x 2 pixels, got shape {heights.shape}")
    check_memory("Height map pixels", heights.size, _BYTES_PER_PIXEL, "cpu", "fewer pixels")
    half = np.array([heights.shape[1] - 1, heights.shape[0] - 1]) * cfg.resolution / 2
    center = np.array(cfg.pos[:2])
    return Ground(heights * cfg.scale + cfg.pos[2], center - half, center + half)


def sample_mesh(cfg: TerrainFileCfg) -> Ground:
    """Measure the height of a mesh's top surface on a grid, by rays from above. Misses are NaN."""
    spec = mujoco.MjSpec()
    # A shell: surfaces are seldom closed.
    spec.add_mesh(
        name="ground",
        file=str(Path(cfg.path).resolve()),
        scale=(cfg.scale,) * 3,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ground", contype=0, conaffinity=0, pos=cfg.pos
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation = data.geom_xmat[0].reshape(3, 3)
    vertices = model.mesh_vert @ rotation.T + data.geom_xpos[0]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cols, rows = (max(2, round(extent / cfg.resolution) + 1) for extent in (high - low)[:2])
    check_memory("Mesh pixels", rows * cols, _BYTES_PER_PIXEL, "cpu", "a coarser resolution")
    inset = _INSIDE * (high - low)
    xs = np.linspace(low[0] + inset[0], high[0] - inset[0], cols)
    ys = np.linspace(low[1] + inset[1], high[1] - inset[1], rows)
    top = high[2] + _ABOVE
    down, heights = np.array([0.0, 0.0, -1.0]), np.full((rows, cols), np.nan)
    for row, col in np.ndindex(rows, cols):
        start = np.array([xs[col], ys[row], top])
        distance = mujoco.mj_rayMesh(model, data, 0, start, down)
        if distance >= 0.0:
            heights[row, col] = top - distance
    return Ground(heights, low[:2], high[:2])
