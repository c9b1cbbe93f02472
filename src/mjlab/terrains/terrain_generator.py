"""A terrain made of a grid of sub-terrains, each of a kind and a difficulty."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco
import numpy as np

from mjlab.sim.memory import available_memory
from mjlab.terrains.utils import FlatPatchSamplingCfg, make_border
from mjlab.utils.errors import (
    WrongStateError,
    check_count,
    check_field,
    check_in_range,
    check_one_of,
)

_COLOR_SCHEMES = ("height", "random", "none")

# Color of the border, and of every geom under the scheme `none`.
_DARK_GREY = (0.2, 0.2, 0.2)
_PLAIN = (0.5, 0.5, 0.5, 1.0)

# Bytes of a pixel, at least: height in the spec, in the model and in the host data's model, and color.
_BYTES_PER_PIXEL = 14

# A sub-terrain's function is given difficulty, spec and generator, but not the cell that it fills.
_CELL: ContextVar[tuple[int, int] | None] = ContextVar("cell", default=None)


@dataclass
class SubTerrainCfg(ABC):
    """Describes one kind of sub-terrain, at every difficulty."""

    proportion: float = 1.0
    """Share of this kind, relative to the others: of the cells, or, in a curriculum (where each
    kind has one column), of the environments."""
    size: tuple[float, float] = (10.0, 10.0)
    """Extent along x and y, in metres. A generator uses its own."""
    flat_patch_sampling: dict[str, FlatPatchSamplingCfg] | None = None
    """Flat spots to look for, by name. Only height fields have them."""

    @abstractmethod
    def function(
        self, difficulty: float, spec: mujoco.MjSpec, rng: np.random.Generator
    ) -> TerrainOutput:
        """Add the sub-terrain's geoms to the body `terrain` of `spec`, and return them.

        Args:
            difficulty: From 0 to 1; both ends are valid.
            spec: The spec, which has the body.
            rng: Source of every random choice.
        """


@dataclass(kw_only=True)
class TerrainGeneratorCfg:
    """Describes a grid of sub-terrains: rows along x, columns along y."""

    seed: int | None = None
    """Seed of all random choices; None takes it from NumPy's global generator, which the seed of
    the environment governs."""
    curriculum: bool = False
    """Whether each kind has one column and rows get harder. Otherwise each cell is of a random
    kind and difficulty."""
    size: tuple[float, float]
    """Extent of each sub-terrain along x and y, in metres."""
    border_width: float = 0.0
    """Width of the frame around the grid, in metres."""
    border_height: float = 1.0
    """Thickness of the frame, whose top is level with z = 0. A negative one makes a wall that
    stands on z = 0."""
    num_rows: int = 1
    """Number of rows; in a curriculum these are the levels."""
    num_cols: int = 1
    """Number of columns. A curriculum has as many as there are sub-terrains instead."""
    color_scheme: Literal["height", "random", "none"] = "height"
    """Colours: those of the sub-terrains, which show height, random ones, or plain grey."""
    sub_terrains: dict[str, SubTerrainCfg] = field(default_factory=dict)
    """The kinds of sub-terrain by name."""
    difficulty_range: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest difficulty, from 0 to 1."""
    add_lights: bool = False
    """Whether to add a light from above that shines on the whole grid."""


@dataclass
class TerrainGeometry:
    """One geom of a sub-terrain."""

    geom: mujoco.MjsGeom | None = None
    """The geom, in the frame of the sub-terrain; the generator moves it to its place."""
    hfield: mujoco.MjsHField | None = None
    """The height field that the geom shows, if any."""
    color: tuple[float, float, float, float] | None = None
    """Colour of the geom under the scheme `height`; None leaves it as it is."""


@dataclass
class TerrainOutput:
    """What the function of a sub-terrain made."""

    origin: np.ndarray
    """(3,) spawn point, in metres from the sub-terrain's corner at its lowest x and y; z is 0 at
    the level of the ground around the terrain."""
    geometries: list[TerrainGeometry]
    """The geoms."""
    flat_patches: dict[str, np.ndarray] | None = None
    """Flat spots by name, (number, 3) positions like the spawn point."""


class TerrainGenerator:
    """Makes the terrain that a config describes. All that it draws comes from one generator.

    Cell (r, c) has its corner of lowest x and y at `(-R Sx / 2 + r Sx, -C Sy / 2 + c Sy, 0)`, for
    R rows, C columns and sub-terrains of size (Sx, Sy).
    """

    def __init__(self, cfg: TerrainGeneratorCfg, device: str = "cpu") -> None:
        """Check the config and lay out the grid.

        Args:
            cfg: What to make. It stays as it is.
            device: Where the terrain's tensors will be; arrays are made on the CPU anyway.

        Raises:
            ValueError: the config makes no sense.
        """
        check_generator(cfg)
        self.cfg = cfg
        self.device = device
        # Copies, because a user's sub-terrain may be part of several terrains of other sizes.
        self._sub_terrains = {name: copy.copy(sub) for name, sub in cfg.sub_terrains.items()}
        for sub in self._sub_terrains.values():
            sub.size = cfg.size
        self.num_rows = cfg.num_rows
        """Number of rows of the grid that is built."""
        self.num_cols = len(self._sub_terrains) if cfg.curriculum else cfg.num_cols
        """Number of columns of the grid that is built."""
        seed = int(np.random.randint(0, 10000)) if cfg.seed is None else cfg.seed
        self.np_rng = np.random.default_rng(seed)
        """Source of every random choice."""
        self.terrain_origins = np.zeros((self.num_rows, self.num_cols, 3))
        """(R, C, 3) spawn points in the world, after `compile`."""
        self.flat_patches: dict[str, np.ndarray] = {}
        """Flat spots by name, (R, C, number, 3) positions in the world, after `compile`."""
        self.flat_patch_radii: dict[str, float] = {}
        """Radius of the flat spots by name, in metres."""
        for sub in self._sub_terrains.values():
            for name, patch in (sub.flat_patch_sampling or {}).items():
                had = self.flat_patches.get(name)
                count = max(patch.num_patches, 0 if had is None else had.shape[2])
                self.flat_patches[name] = np.zeros((self.num_rows, self.num_cols, count, 3))
                radius = max(patch.patch_radius, self.flat_patch_radii.get(name, 0.0))
                self.flat_patch_radii[name] = radius

    @property
    def proportions(self) -> np.ndarray:
        """Shares of the sub-terrains, in their order; they sum to 1."""
        shares = np.array([sub.proportion for sub in self._sub_terrains.values()], dtype=float)
        return shares / shares.sum()

    def compile(self, spec: mujoco.MjSpec) -> None:
        """Add the terrain to `spec`, as one static body `terrain` of the world."""
        body = spec.worldbody.add_body(name="terrain")
        self._num_pixels, self._memory = 0, available_memory("cpu")
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
        if self.cfg.border_width > 0.0:
            self._add_border(body, extent)
        if self.cfg.add_lights:
            body.add_light(
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                pos=(0.0, 0.0, 0.6 * max(extent)),
                dir=(0.0, 0.0, -1.0),
            )
        for index, geom in enumerate(body.geoms):
            # The ground's mass would be most of the model's, whose mean scales what viewers draw.
            geom.mass = 0.0
            if not geom.name:
                geom.name = f"terrain_{index}"

    def _fill_cell(
        self, spec: mujoco.MjSpec, row: int, col: int, name: str, difficulty: float
    ) -> None:
        sub = self._sub_terrains[name]
        try:
            with naming_cell(row, col):
                output = sub.function(difficulty, spec, self.np_rng)
            check_output(output, self.flat_patches)
            self._check_memory(output)
        except (ValueError, RuntimeError) as error:
            kinds = (ValueError, WrongStateError, RuntimeError)
            kind = next(kind for kind in kinds if isinstance(error, kind))
            raise kind(f"Sub-terrain {name!r} at difficulty {difficulty:.3g}: {error}") from error
        size_x, size_y = self.cfg.size
        corner = np.array(
            [(row - self.num_rows / 2) * size_x, (col - self.num_cols / 2) * size_y, 0.0]
        )
        for geometry in output.geometries:
            if geometry.geom is not None:
                geometry.geom.pos = np.asarray(geometry.geom.pos) + corner
                self._paint(geometry.geom, geometry.color)
        self.terrain_origins[row, col] = output.origin + corner
        for patch, kept in self.flat_patches.items():
            # Places that are not used hold the spawn point.
            kept[row, col] = self.terrain_origins[row, col]
            found = (output.flat_patches or {}).get(patch, ())
            if len(found):
                kept[row, col, : len(found)] = found + corner

    def _check_memory(self, output: TerrainOutput) -> None:
        """Raise `ValueError` if the height fields so far need more memory than was available."""
        fields = [part.hfield for part in output.geometries if part.hfield is not None]
        self._num_pixels += sum(field.nrow * field.ncol for field in fields)
        if self._memory is not None and self._num_pixels * _BYTES_PER_PIXEL > self._memory:
            raise ValueError(
                f"height fields: expected at most {self._memory // _BYTES_PER_PIXEL:,} pixels, "
                f"which is what {self._memory / 1e9:.1f} GB of memory can hold, got "
                f"{self._num_pixels:,} so far; use a larger horizontal_scale, or fewer sub-terrains."
            )

    def _paint(self, geom: mujoco.MjsGeom, color: tuple[float, float, float, float] | None) -> None:
        """Color a geom; `color` is that of its sub-terrain."""
        if self.cfg.color_scheme == "random":
            color = (*self.np_rng.uniform(0.3, 0.8, 3).tolist(), 1.0)
        elif self.cfg.color_scheme == "none":
            color = _PLAIN
        if color is not None:
            geom.rgba = np.array(color)

    def _add_border(self, body: mujoco.MjsBody, extent: tuple[float, float]) -> None:
        """Add a frame around the grid of the given extent, which is centred on the origin."""
        width, height = self.cfg.border_width, self.cfg.border_height
        is_random = self.cfg.color_scheme == "random"
        color = self.np_rng.random(3) if is_random else _DARK_GREY
        outer = (extent[0] + 2.0 * width, extent[1] + 2.0 * width)
        for geom in make_border(body, outer, extent, abs(height), (0.0, 0.0, -height / 2)):
            geom.rgba = (*color, 1.0)


@contextmanager
def naming_cell(row: int, col: int) -> Generator[None]:
    """Let `asset_name` name what is added in this context after the cell."""
    token = _CELL.set((row, col))
    try:
        yield
    finally:
        _CELL.reset(token)


def asset_name(spec: mujoco.MjSpec, kind: str) -> str:
    """Return a name for an asset of a sub-terrain, `<kind>_<row>_<column>` in a generated grid.

    Elsewhere the name ends with the number of assets that the spec has, so that it is new after
    each added asset. The same calls give the same names, in every process.

    Args:
        spec: The spec that will hold the asset.
        kind: What the asset is, `hfield` say. Different for each asset of one sub-terrain.
    """
    cell = _CELL.get()
    if cell is not None:
        return f"{kind}_{cell[0]}_{cell[1]}"
    count = len(spec.hfields) + len(spec.meshes) + len(spec.textures) + len(spec.materials)
    return f"{kind}_{count}"


def check_generator(cfg: TerrainGeneratorCfg) -> None:
    """Raise ValueError, with what to change, for a config that cannot be built."""
    example = "at least one sub-terrain, such as {'flat': BoxFlatTerrainCfg()}"
    check_field(cfg, "sub_terrains", bool(cfg.sub_terrains), example)
    is_size = len(cfg.size) == 2 and all(0.0 < side < math.inf for side in cfg.size)
    check_field(cfg, "size", is_size, "two positive lengths, in metres")
    check_count("TerrainGeneratorCfg.num_rows", cfg.num_rows)
    check_count("TerrainGeneratorCfg.num_cols", cfg.num_cols)
    check_one_of("TerrainGeneratorCfg.color_scheme", cfg.color_scheme, _COLOR_SCHEMES)
    low, high = cfg.difficulty_range
    ends = "(lowest, highest), both from 0 to 1"
    check_field(cfg, "difficulty_range", 0.0 <= low <= high <= 1.0, ends)
    side = min(cfg.size)
    for name, sub in cfg.sub_terrains.items():
        where = f"Sub-terrain {name!r} ({type(sub).__name__})"
        if not 0.0 <= sub.proportion < math.inf:
            raise ValueError(f"{where} proportion: expected a number >= 0, got {sub.proportion}.")
        platform: Any = getattr(sub, "platform_width", 0.0)
        check_in_range(f"{where} platform_width", platform, 0.0, side)
        border: Any = getattr(sub, "border_width", 0.0)
        if not 0.0 <= border < side / 2:
            raise ValueError(
                f"{where} border_width: expected a length in [0, {side / 2}), less than half the "
                f"sub-terrain, got {border}."
            )
        for key, patch in (sub.flat_patch_sampling or {}).items():
            check_count(f"{where} flat_patch_sampling[{key!r}] num_patches", patch.num_patches)
            radius = f"{where} flat_patch_sampling[{key!r}] patch_radius"
            check_in_range(radius, patch.patch_radius, 0.0, math.inf)
    if not any(sub.proportion for sub in cfg.sub_terrains.values()):
        raise ValueError(
            f"SubTerrainCfg.proportion is 0 for all of {sorted(cfg.sub_terrains)}. At least one "
            "must be positive."
        )


def check_output(output: TerrainOutput, patches: dict[str, np.ndarray]) -> None:
    """Raise ValueError if the function of a sub-terrain returned what cannot be used."""
    origin = np.asarray(output.origin)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise ValueError(f"its origin is {output.origin}; it must be three finite numbers.")
    for name, found in (output.flat_patches or {}).items():
        if name not in patches:
            raise ValueError(
                f"it returned flat patches {name!r}, which SubTerrainCfg.flat_patch_sampling does "
                f"not have; that has {sorted(patches)}."
            )
        room = patches[name].shape[2]
        if np.ndim(found) != 2 or np.shape(found)[1] != 3 or len(found) > room:
            raise ValueError(
                f"its flat patches {name!r} have the shape {np.shape(found)}; it must be (n, 3) "
                f"with at most {room} patches, as configured."
            )
