"""Terrain generator: grid of sub-terrains of several types and difficulties."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

from mjlab.terrains.utils import FlatPatchSamplingCfg, make_border
from mjlab.utils.errors import check_count, check_field
from mjlab.utils.memory import check_memory

# Color of the border, and of every geom under the scheme `none`.
_DARK_GRAY = (0.2, 0.2, 0.2)
_PLAIN = (0.5, 0.5, 0.5, 1.0)


@dataclass
class SubTerrainCfg(ABC):
    """Configuration of one sub-terrain type, for all difficulties."""

    proportion: float = 1.0
    """Share of this type relative to the others: of the cells, or of the environments in a
    curriculum (one column per type)."""
    size: tuple[float, float] = (10.0, 10.0)
    """Extent along x and y (m). A generator overrides it."""
    flat_patch_sampling: dict[str, FlatPatchSamplingCfg] | None = None
    """Flat patches to sample, by name. Height fields only."""

    @abstractmethod
    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the sub-terrain's geoms to the body `terrain` of `spec`, and return them.

        Args:
            difficulty: Difficulty in [0, 1].
            spec: Spec with the body `terrain`.
            rng: Source of all random numbers.
        """


@dataclass(kw_only=True)
class TerrainGeneratorCfg:
    """Configuration of a grid of sub-terrains: rows along x, columns along y."""

    seed: int | None = None
    """Random seed. None: drawn from NumPy's global generator, seeded by the environment."""
    curriculum: bool = False
    """Use one column per type, with difficulty increasing over rows. Otherwise each cell has a
    random type and difficulty."""
    size: tuple[float, float]
    """Extent of each sub-terrain along x and y (m)."""
    border_width: float = 0.0
    """Width of the border around the grid (m)."""
    border_height: float = 1.0
    """Thickness of the border below z = 0 (m). Negative: height of a wall above z = 0."""
    num_rows: int = 1
    """Number of rows. Rows are the levels of a curriculum."""
    num_cols: int = 1
    """Number of columns. Ignored in a curriculum (one column per sub-terrain)."""
    color_scheme: Literal["height", "random", "none"] = "height"
    """Color scheme: `height` (colors of the sub-terrains), `random`, or `none` (plain gray)."""
    sub_terrains: dict[str, SubTerrainCfg] = field(default_factory=dict)
    """Sub-terrain types by name."""
    difficulty_range: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest difficulty, in [0, 1]."""
    add_lights: bool = False
    """Add a directional light above the grid."""


@dataclass
class TerrainGeometry:
    """Geom of a sub-terrain."""

    geom: mujoco.MjsGeom | None = None
    """Geom in the sub-terrain frame. The generator moves it to its cell."""
    hfield: mujoco.MjsHField | None = None
    """Height field of the geom, if any."""
    color: tuple[float, float, float, float] | None = None
    """Color under the scheme `height`. None: unchanged."""


@dataclass
class TerrainOutput:
    """Result of `SubTerrainCfg.function`."""

    origin: np.ndarray
    """Spawn point relative to the sub-terrain's corner of lowest x and y (m), (3,); z = 0 is the
    level of the ground around the terrain."""
    geometries: list[TerrainGeometry]
    """Geoms of the sub-terrain."""
    flat_patches: dict[str, np.ndarray] | None = None
    """Positions of flat patches by name (m), in the frame of `origin`, (n, 3)."""


class TerrainGenerator:
    """Generator of a sub-terrain grid. All random numbers come from `np_rng`.

    Cell (r, c) has its corner of lowest x and y at `(-R Sx / 2 + r Sx, -C Sy / 2 + c Sy, 0)`, for
    R rows, C columns and sub-terrains of size (Sx, Sy).
    """

    def __init__(self, cfg: TerrainGeneratorCfg, device: str = "cpu") -> None:
        """Lay out the grid.

        Args:
            cfg: Configuration. It is not modified.
            device: Torch device of the terrain's tensors. Arrays are created on the CPU.

        Raises:
            ValueError: no sub-terrains, rows or columns, or too many for the memory.
        """
        expected = "at least one sub-terrain, e.g. {'flat': BoxFlatTerrainCfg()}"
        check_field(cfg, "sub_terrains", len(cfg.sub_terrains) > 0, expected)
        self.cfg = cfg
        self.device = device
        # Copies, because several terrains of different sizes may share a sub-terrain config.
        self._sub_terrains = {name: copy.copy(sub) for name, sub in cfg.sub_terrains.items()}
        for sub in self._sub_terrains.values():
            sub.size = cfg.size
        self.num_rows = cfg.num_rows
        """Number of rows of the generated grid."""
        self.num_cols = len(self._sub_terrains) if cfg.curriculum else cfg.num_cols
        """Number of columns of the generated grid."""
        seed = int(np.random.randint(0, 10000)) if cfg.seed is None else cfg.seed
        self.np_rng = np.random.default_rng(seed)
        """Source of all random numbers."""
        check_count("TerrainGeneratorCfg.num_rows", self.num_rows)
        check_count("TerrainGeneratorCfg.num_cols", self.num_cols)
        num_cells = self.num_rows * self.num_cols
        check_memory("TerrainGeneratorCfg cells", num_cells, 24, "cpu", "fewer rows and columns")
        self.terrain_origins = np.zeros((self.num_rows, self.num_cols, 3))
        """Spawn points in the world frame (m), (R, C, 3). Zero before `compile`."""
        self.flat_patches: dict[str, np.ndarray] = {}
        """World positions of flat patches by name (m), (R, C, n, 3). Zero before `compile`."""
        self.flat_patch_radii: dict[str, float] = {}
        """Radius of flat patches by name (m)."""
        for sub in self._sub_terrains.values():
            for name, patch in (sub.flat_patch_sampling or {}).items():
                had = self.flat_patches.get(name)
                count = max(patch.num_patches, 0 if had is None else had.shape[2])
                self.flat_patches[name] = np.zeros((self.num_rows, self.num_cols, count, 3))
                radius = max(patch.patch_radius, self.flat_patch_radii.get(name, 0.0))
                self.flat_patch_radii[name] = radius

    @property
    def proportions(self) -> np.ndarray:
        """Normalized proportions of the sub-terrains, in config order."""
        shares = np.array([sub.proportion for sub in self._sub_terrains.values()], dtype=float)
        return shares / shares.sum()

    def compile(self, spec: mujoco.MjSpec) -> None:
        """Add the terrain to `spec` as one static body `terrain`."""
        body = spec.worldbody.add_body(name="terrain")
        low, high = self.cfg.difficulty_range
        names, shares = list(self._sub_terrains), self.proportions
        if self.cfg.curriculum:
            for col, name in enumerate(names):
                for row in range(self.num_rows):
                    difficulty = low + (high - low) * row / max(self.num_rows - 1, 1)
                    self._fill_cell(spec, row, col, name, difficulty)
        else:
            for row in range(self.num_rows):
                for col in range(self.num_cols):
                    name = names[self.np_rng.choice(len(names), p=shares)]
                    self._fill_cell(spec, row, col, name, float(self.np_rng.uniform(low, high)))
        extent = (self.num_rows * self.cfg.size[0], self.num_cols * self.cfg.size[1])
        width, height = self.cfg.border_width, self.cfg.border_height
        if width > 0.0:
            outer = (extent[0] + 2.0 * width, extent[1] + 2.0 * width)
            is_random = self.cfg.color_scheme == "random"
            color = self.np_rng.random(3) if is_random else _DARK_GRAY
            for geom in make_border(body, outer, extent, abs(height), (0.0, 0.0, -height / 2)):
                geom.rgba = (*color, 1.0)
        if self.cfg.add_lights:
            body.add_light(
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                pos=(0.0, 0.0, 0.6 * max(extent)),
                dir=(0.0, 0.0, -1.0),
            )
        for index, geom in enumerate(body.geoms):
            # The ground would dominate the model's mean mass, which scales drawings in viewers.
            geom.mass = 0.0
            if not geom.name:
                geom.name = f"terrain_{index}"

    def _fill_cell(
        self, spec: mujoco.MjSpec, row: int, col: int, name: str, difficulty: float
    ) -> None:
        sub = self._sub_terrains[name]
        try:
            output = sub.function(difficulty, spec, self.np_rng)
        except (ValueError, RuntimeError) as error:
            place = f"Sub-terrain {name!r} at difficulty {difficulty:.3g}"
            raise type(error)(f"{place}: {error}") from error
        size_x, size_y = self.cfg.size
        corner = np.array(
            [(row - self.num_rows / 2) * size_x, (col - self.num_cols / 2) * size_y, 0.0]
        )
        for geometry in output.geometries:
            if geometry.geom is None:
                continue
            geometry.geom.pos = np.asarray(geometry.geom.pos) + corner
            color = _PLAIN if self.cfg.color_scheme == "none" else geometry.color
            if self.cfg.color_scheme == "random":
                color = (*self.np_rng.uniform(0.3, 0.8, 3).tolist(), 1.0)
            if color is not None:
                geometry.geom.rgba = np.array(color)
        self.terrain_origins[row, col] = output.origin + corner
        for patch, kept in self.flat_patches.items():
            # Unused entries hold the spawn point.
            kept[row, col] = self.terrain_origins[row, col]
            found = (output.flat_patches or {}).get(patch, np.zeros((0, 3)))
            kept[row, col, : len(found)] = found + corner


def asset_name(spec: mujoco.MjSpec, kind: str) -> str:
    """Return an unused name for an asset of a sub-terrain: `<kind>_<number of assets in the spec>`.

    Names are reproducible across processes.

    Args:
        spec: Spec that will hold the asset.
        kind: Asset type, e.g. `hfield`.
    """
    count = len(spec.hfields) + len(spec.meshes) + len(spec.textures) + len(spec.materials)
    return f"{kind}_{count}"
