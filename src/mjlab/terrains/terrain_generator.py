"""Terrain generator: grid of sub-terrains of several types and difficulties."""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.terrains.utils import FlatPatchSamplingCfg, check_flat_patch, make_border
from mjlab.utils.errors import (
    WrongStateError,
    check_count,
    check_field,
)
from mjlab.utils.memory import check_memory

_COLOR_SCHEMES = ("height", "random", "none")

# Color of the border, and of every geom under the scheme `none`.
_DARK_GRAY = (0.2, 0.2, 0.2)
_PLAIN = (0.5, 0.5, 0.5, 1.0)

# Minimum bytes per pixel: heights in the spec, the model and the host data's model, and color.
BYTES_PER_PIXEL = 14


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
        """Check the config and lay out the grid.

        Args:
            cfg: Configuration. It is not modified.
            device: Torch device of the terrain's tensors. Arrays are created on the CPU.

        Raises:
            ValueError: invalid config.
        """
        check_generator(cfg)
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

    # Sub-terrains of infinite size have no place: see the warning.
    @np.errstate(invalid="ignore")
    def compile(self, spec: mujoco.MjSpec) -> None:
        """Add the terrain to `spec` as one static body `terrain`."""
        body = spec.worldbody.add_body(name="terrain")
        self._num_pixels, self._fits = 0, True
        self._dropped_patches: set[str] = set()
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
        odd = []
        if self._dropped_patches:
            odd.append(
                f"unknown flat patches {sorted(self._dropped_patches)} are dropped; names in "
                f"SubTerrainCfg.flat_patch_sampling: {sorted(self.flat_patches)}"
            )
        if not np.isfinite(self.terrain_origins).all():
            odd.append(
                "expected finite numbers in TerrainGeneratorCfg.size and TerrainOutput.origin, got NaN "
                "or inf, so robots have no place"
            )
        if odd:
            warnings.warn(f"Terrain: {'; '.join(odd)}.", UserWarning, stacklevel=2)
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
            check_output(output, self.flat_patches)
            fields = [part.hfield for part in output.geometries if part.hfield is not None]
            self._num_pixels += sum(field.nrow * field.ncol for field in fields)
            cure = "a larger horizontal_scale, or fewer sub-terrains"
            self._fits &= check_memory(
                "pixels of all height fields", self._num_pixels, BYTES_PER_PIXEL, "cpu", cure,
                warns=self._fits,
            )  # fmt: skip
        except (ValueError, RuntimeError) as error:
            kinds = (ValueError, WrongStateError, RuntimeError)
            kind = next(kind for kind in kinds if isinstance(error, kind))
            raise kind(f"Sub-terrain {name!r} at difficulty {difficulty:.3g}: {error}") from error
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
        self._dropped_patches |= (output.flat_patches or {}).keys() - self.flat_patches.keys()
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


def check_generator(cfg: TerrainGeneratorCfg) -> None:
    """Raise `ValueError` for an invalid config. Warn of values outside their range."""
    expected = "at least one sub-terrain with proportion > 0, e.g. {'flat': BoxFlatTerrainCfg()}"
    shares = np.array([sub.proportion for sub in cfg.sub_terrains.values()], dtype=float)
    total = shares.sum()
    has_share = total != 0.0 and bool((shares / total >= 0.0).all()) and math.isfinite(total)
    check_field(cfg, "sub_terrains", has_share, expected)
    is_size = len(cfg.size) == 2 and all(side > 0.0 for side in cfg.size)
    check_field(cfg, "size", is_size, "two lengths > 0 m")
    check_count("TerrainGeneratorCfg.num_rows", cfg.num_rows)
    if not cfg.curriculum:
        check_count("TerrainGeneratorCfg.num_cols", cfg.num_cols)
    odd = []
    if cfg.color_scheme not in _COLOR_SCHEMES:
        odd.append(f"color_scheme: expected one of {_COLOR_SCHEMES}, got {cfg.color_scheme!r}")
    low, high = cfg.difficulty_range
    if not 0.0 <= low <= high <= 1.0:
        expected = "(low, high) with 0 <= low <= high <= 1"
        odd.append(f"difficulty_range: expected {expected}, got {cfg.difficulty_range}")
    side = min(cfg.size)
    for name, sub in cfg.sub_terrains.items():
        owner = f"sub-terrain {name!r} ({type(sub).__name__})"
        platform: Any = getattr(sub, "platform_width", 0.0)
        if not 0.0 <= platform <= side:
            odd.append(f"{owner} platform_width: expected 0 to {side} m, got {platform}")
        border: Any = getattr(sub, "border_width", 0.0)
        if not 0.0 <= border < side / 2:
            odd.append(
                f"{owner} border_width: expected a length in [0, {side / 2}) m (less than half the "
                f"sub-terrain), got {border}"
            )
        if getattr(sub, "grid_width", 1.0) < 0.0:
            odd.append(f"{owner} grid_width: expected a length > 0 m")
        for key, patch in (sub.flat_patch_sampling or {}).items():
            check_flat_patch(f"TerrainGeneratorCfg {owner}", key, patch)
    if odd:
        warnings.warn(f"TerrainGeneratorCfg {'; '.join(odd)}.", UserWarning, stacklevel=3)


def check_output(output: TerrainOutput, patches: dict[str, np.ndarray]) -> None:
    """Raise `ValueError` for an invalid result of `SubTerrainCfg.function`."""
    origin = np.asarray(output.origin)
    if origin.shape != (3,):
        raise ValueError(f"origin: expected three numbers, got {output.origin}.")
    for name, found in (output.flat_patches or {}).items():
        room = patches[name].shape[2] if name in patches else len(found)
        if np.ndim(found) != 2 or np.shape(found)[1] != 3 or len(found) > room:
            raise ValueError(
                f"flat patches {name!r}: expected shape (n, 3) with n <= {room} (num_patches), got "
                f"{np.shape(found)}."
            )
