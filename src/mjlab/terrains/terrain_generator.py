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

from mjlab.terrains.utils import make_border

# MERGED mjlab.terrains.terrain_generator: Terrain configs that cannot be built are refused here, before anything is built.

_COLOR_SCHEMES = ("height", "random", "none")


def check_generator(cfg: TerrainGeneratorCfg) -> None:
    """Raise ValueError, with what to change, for a config that cannot be built."""
    if not cfg.sub_terrains:
        raise ValueError(
            "TerrainGeneratorCfg.sub_terrains is empty. Give at least one sub-terrain, such as "
            "{'flat': BoxFlatTerrainCfg()}."
        )
    if len(cfg.size) != 2 or not all(math.isfinite(side) and side > 0.0 for side in cfg.size):
        raise ValueError(
            f"TerrainGeneratorCfg.size is {tuple(cfg.size)}; it must be two positive lengths, in "
            "metres."
        )
    for name in ("num_rows", "num_cols"):
        if getattr(cfg, name) < 1:
            raise ValueError(
                f"TerrainGeneratorCfg.{name} is {getattr(cfg, name)}; it must be at least 1."
            )
    if cfg.color_scheme not in _COLOR_SCHEMES:
        raise ValueError(
            f"TerrainGeneratorCfg.color_scheme is {cfg.color_scheme!r}; it must be one of "
            f"{', '.join(_COLOR_SCHEMES)}."
        )
    _check_difficulties(cfg.difficulty_range)
    _check_proportions({name: sub.proportion for name, sub in cfg.sub_terrains.items()})
    for name, sub in cfg.sub_terrains.items():
        _check_sub_terrain(name, sub, min(cfg.size))


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


def _check_difficulties(bounds: tuple[float, float]) -> None:
    if not 0.0 <= bounds[0] <= bounds[1] <= 1.0:
        raise ValueError(
            f"TerrainGeneratorCfg.difficulty_range is {tuple(bounds)}; it must be (lowest, "
            "highest), both from 0 to 1."
        )


def _check_proportions(proportions: dict[str, float]) -> None:
    bad = {name: p for name, p in proportions.items() if not (math.isfinite(p) and p >= 0.0)}
    if bad:
        raise ValueError(
            f"SubTerrainCfg.proportion is negative or not finite for {bad}. Use 0 or more; "
            "proportions are relative to each other."
        )
    if sum(proportions.values()) <= 0.0:
        raise ValueError(
            f"SubTerrainCfg.proportion is 0 for all of {sorted(proportions)}. At least one must "
            "be positive."
        )


def _check_sub_terrain(name: str, sub: SubTerrainCfg, side: float) -> None:
    """Check the fields that most sub-terrains have against the shorter side of a cell."""
    where = f"Sub-terrain {name!r} ({type(sub).__name__})"
    platform: Any = getattr(sub, "platform_width", 0.0)
    if not 0.0 <= platform <= side:
        raise ValueError(
            f"{where}: platform_width is {platform}; it must be from 0 to the size of the "
            f"terrain, {side} m."
        )
    border: Any = getattr(sub, "border_width", 0.0)
    if not 0.0 <= border < side / 2:
        raise ValueError(
            f"{where}: border_width is {border}; it must be at least 0 and thinner than half the "
            f"terrain, {side / 2} m."
        )
    for key, patch in (sub.flat_patch_sampling or {}).items():
        if patch.num_patches < 1 or patch.patch_radius < 0.0:
            raise ValueError(
                f"{where}: flat_patch_sampling[{key!r}] asks for {patch.num_patches} patches of "
                f"radius {patch.patch_radius} m; it must be at least 1, of radius 0 or more."
            )


# MERGED mjlab.terrains.terrain_generator: What surrounds the grid of sub-terrains: the frame, the light, and names for all geoms.

_DARK_GREY = (0.2, 0.2, 0.2)


def add_border(
    body: mujoco.MjsBody,
    extent: tuple[float, float],
    width: float,
    height: float,
    color: np.ndarray | None,
) -> None:
    """Add a frame around the grid.

    Args:
        body: The body of the terrain.
        extent: Extent of the grid along x and y, in metres; it is centred on the origin.
        width: Width of the frame, in metres.
        height: Thickness of the frame below z = 0, or, negative, height of a wall above it.
        color: (3,) red, green and blue; None is a dark grey.
    """
    outer = (extent[0] + 2.0 * width, extent[1] + 2.0 * width)
    for geom in make_border(body, outer, extent, abs(height), (0.0, 0.0, -height / 2)):
        geom.rgba = (*(_DARK_GREY if color is None else color), 1.0)


def add_light(body: mujoco.MjsBody, extent: tuple[float, float]) -> None:
    """Add a light that shines straight down on the grid, from a height that suits its extent."""
    body.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0.0, 0.0, 0.6 * max(extent)),
        dir=(0.0, 0.0, -1.0),
    )


def finish_geoms(body: mujoco.MjsBody) -> None:
    """Name the geoms that have no name `terrain_<k>`, k counting all, and make all weightless.

    The ground's mass would be most of the model's, whose mean mass scales what viewers draw.
    """
    for index, geom in enumerate(body.geoms):
        geom.mass = 0.0
        if not geom.name:
            geom.name = f"terrain_{index}"


# MERGED mjlab.terrains.terrain_generator: Names of the assets that sub-terrains add to the spec.


# A sub-terrain's function is given difficulty, spec and generator, but not the cell that it fills.
_CELL: ContextVar[tuple[int, int] | None] = ContextVar("cell", default=None)


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


# What the scheme `none` gives every geom.
_PLAIN = (0.5, 0.5, 0.5, 1.0)


@dataclass
class FlatPatchSamplingCfg:
    """Describes which flat spots of a height field to look for."""

    num_patches: int = 10
    """Number of spots."""
    patch_radius: float = 0.5
    """Radius of a spot, in metres."""
    max_height_diff: float = 0.05
    """Largest difference in height within a spot, in metres."""
    x_range: tuple[float, float] = (-1e6, 1e6)
    """Where the middle of a spot may be along x, in metres from the corner of the sub-terrain."""
    y_range: tuple[float, float] = (-1e6, 1e6)
    """Where the middle of a spot may be along y, likewise."""
    z_range: tuple[float, float] = (-1e6, 1e6)
    """How high the middle of a spot may be in the world, in metres."""
    grid_resolution: float | None = None
    """Distance of the points that are tried, in metres, where finer than those of the field."""


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
            self._reserve_patches(sub)

    @property
    def proportions(self) -> np.ndarray:
        """Shares of the sub-terrains, in their order; they sum to 1."""
        shares = np.array([sub.proportion for sub in self._sub_terrains.values()], dtype=float)
        return shares / shares.sum()

    def compile(self, spec: mujoco.MjSpec) -> None:
        """Add the terrain to `spec`, as one static body `terrain` of the world."""
        body = spec.worldbody.add_body(name="terrain")
        if self.cfg.curriculum:
            self._make_curriculum(spec)
        else:
            self._make_random(spec)
        extent = (self.num_rows * self.cfg.size[0], self.num_cols * self.cfg.size[1])
        if self.cfg.border_width > 0.0:
            color = self.np_rng.random(3) if self.cfg.color_scheme == "random" else None
            add_border(body, extent, self.cfg.border_width, self.cfg.border_height, color)
        if self.cfg.add_lights:
            add_light(body, extent)
        finish_geoms(body)

    # The grid.

    def _make_curriculum(self, spec: mujoco.MjSpec) -> None:
        """Fill each column with one kind, harder from row to row."""
        low, high = self.cfg.difficulty_range
        for col, name in enumerate(self._sub_terrains):
            for row in range(self.num_rows):
                difficulty = low + (high - low) * row / max(self.num_rows - 1, 1)
                self._fill_cell(spec, row, col, name, difficulty)

    def _make_random(self, spec: mujoco.MjSpec) -> None:
        """Fill each cell with a random kind of a random difficulty, row by row."""
        names, shares = list(self._sub_terrains), self.proportions
        for row in range(self.num_rows):
            for col in range(self.num_cols):
                name = names[self.np_rng.choice(len(names), p=shares)]
                difficulty = float(self.np_rng.uniform(*self.cfg.difficulty_range))
                self._fill_cell(spec, row, col, name, difficulty)

    def _fill_cell(
        self, spec: mujoco.MjSpec, row: int, col: int, name: str, difficulty: float
    ) -> None:
        sub = self._sub_terrains[name]
        try:
            with naming_cell(row, col):
                output = sub.function(difficulty, spec, self.np_rng)
            check_output(output, self.flat_patches)
        except (ValueError, RuntimeError) as error:
            kind = ValueError if isinstance(error, ValueError) else RuntimeError
            raise kind(f"Sub-terrain {name!r} at difficulty {difficulty:.3g}: {error}") from error
        corner = self._corner(row, col)
        for geometry in output.geometries:
            if geometry.geom is not None:
                geometry.geom.pos = np.asarray(geometry.geom.pos) + corner
                self._paint(geometry.geom, geometry.color)
        self.terrain_origins[row, col] = output.origin + corner
        self._keep_patches(row, col, output, corner)

    def _corner(self, row: int, col: int) -> np.ndarray:
        """Return the (3,) position of the corner of a cell that has the lowest x and y."""
        size_x, size_y = self.cfg.size
        return np.array(
            [(row - self.num_rows / 2) * size_x, (col - self.num_cols / 2) * size_y, 0.0]
        )

    def _paint(self, geom: mujoco.MjsGeom, color: tuple[float, float, float, float] | None) -> None:
        """Colour a geom; `color` is what its sub-terrain would have."""
        if self.cfg.color_scheme == "random":
            color = (*self.np_rng.uniform(0.3, 0.8, 3).tolist(), 1.0)
        elif self.cfg.color_scheme == "none":
            color = _PLAIN
        if color is not None:
            geom.rgba = np.array(color)

    # Flat patches.

    def _reserve_patches(self, sub: SubTerrainCfg) -> None:
        """Make room for the flat spots that a sub-terrain asks for."""
        for name, patch in (sub.flat_patch_sampling or {}).items():
            had = self.flat_patches.get(name)
            count = max(patch.num_patches, 0 if had is None else had.shape[2])
            self.flat_patches[name] = np.zeros((self.num_rows, self.num_cols, count, 3))
            radius = max(patch.patch_radius, self.flat_patch_radii.get(name, 0.0))
            self.flat_patch_radii[name] = radius

    def _keep_patches(self, row: int, col: int, output: TerrainOutput, corner: np.ndarray) -> None:
        """Store the flat spots of a cell. Places that are not used hold the spawn point."""
        found = output.flat_patches or {}
        for name, kept in self.flat_patches.items():
            kept[row, col] = self.terrain_origins[row, col]
            if name in found:
                kept[row, col, : len(found[name])] = found[name] + corner
