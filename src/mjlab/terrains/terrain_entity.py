"""Terrain entity: the ground and the environment origins on it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, NoReturn

import mujoco
import numpy as np
import torch

from mjlab.entity import Entity, EntityCfg
from mjlab.terrains.terrain_file import TerrainFileCfg, add_ground
from mjlab.terrains.terrain_generator import TerrainGenerator, TerrainGeneratorCfg
from mjlab.utils import spec_config as spec_cfg
from mjlab.utils.errors import WrongTypeError, check_one_of

# Debug sites.
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_GREEN = (0.2, 0.6, 0.2, 0.3)
_BLUE = (0.2, 0.2, 0.6, 0.3)
_YELLOW = (0.6, 0.6, 0.2, 0.3)

# Half height of the box that marks a flat patch (m).
_PATCH_HALF_HEIGHT = 0.02


_SUN = spec_cfg.LightCfg(name="sun", type="directional", pos=(0.0, 0.0, 1.5))
_GROUND_TEXTURE = spec_cfg.TextureCfg(
    name="groundplane",
    type="2d",
    builtin="checker",
    rgb1=(0.2, 0.3, 0.4),
    rgb2=(0.1, 0.2, 0.3),
    width=300,
    height=300,
    mark="edge",
    markrgb=(0.8, 0.8, 0.8),
)
_GROUND_MATERIAL = spec_cfg.MaterialCfg(
    name="groundplane",
    texuniform=True,
    texrepeat=(4.0, 4.0),
    reflectance=0.2,
    texture="groundplane",
    geom_names_expr=("terrain$",),
)


@dataclass
class TerrainEntityCfg(EntityCfg):
    """Terrain configuration, for `SceneCfg.terrain`."""

    lights: tuple[spec_cfg.LightCfg, ...] = (_SUN,)
    """Lights to add."""
    textures: tuple[spec_cfg.TextureCfg, ...] = (_GROUND_TEXTURE,)
    """Textures to add."""
    materials: tuple[spec_cfg.MaterialCfg, ...] = (_GROUND_MATERIAL,)
    """Materials to add and to assign to geoms."""
    terrain_type: Literal["generator", "plane", "mesh", "heightmap"] = "plane"
    """Terrain type: `plane` (one infinite plane), `generator` (grid of sub-terrains), or `mesh` or
    `heightmap` (ground from a file)."""
    terrain_generator: TerrainGeneratorCfg | None = None
    """Sub-terrain grid of type `generator`."""
    env_spacing: float | None = 2.0
    """Distance between environment origins on a plane or a ground from a file (m). A scene sets this
    field."""
    max_init_terrain_level: int | None = None
    """Highest initial level (row) of environments on a generated terrain. None: all levels."""
    num_envs: int = 1
    """Number of environments. A scene sets this field."""
    debug_vis: bool = False
    """Add sites at environment origins, and at the terrain's spawn points and flat patches."""
    terrain_file: TerrainFileCfg | None = dataclasses.field(default=None, kw_only=True)
    """File and placement of types `mesh` and `heightmap`."""

    def build(self) -> NoReturn:
        """Raise `TypeError`: a terrain needs a device. Use `TerrainEntity(cfg, device)`."""
        raise WrongTypeError(
            "TerrainEntityCfg.build() is not supported, because a terrain needs a device; set "
            "SceneCfg.terrain, or use TerrainEntity(cfg, device)."
        )


class TerrainEntity(Entity):
    """Ground of the scene: one static body `terrain`, and the environment origins."""

    # The config defines the ground; checkpoints hold the levels and columns of environments.
    _transient = {"_device", "_flat_patches", "_flat_patch_radii", "_holds_levels", "bounds"}

    cfg: TerrainEntityCfg

    def __init__(self, cfg: TerrainEntityCfg, device: str) -> None:
        """Build the ground and place the environments on it.

        Raises:
            ValueError: invalid config.
        """
        self._device = device
        self.env_origins = torch.zeros(cfg.num_envs, 3, dtype=torch.float32, device=device)
        """World positions of the environment origins (m), (N, 3)."""
        self.terrain_origins: torch.Tensor | None = None
        """Spawn points of a grid of R levels and C columns (m), (R, C, 3). None on a plane."""
        self.terrain_levels: torch.Tensor | None = None
        """Level (row) of each environment, (N,). None on a plane."""
        self.terrain_types: torch.Tensor | None = None
        """Column of each environment, (N,). None on a plane."""
        self.max_terrain_level = 0
        """Number of levels. 0 on a plane."""
        self.terrain_generator: TerrainGenerator | None = None
        """Generator of the terrain. None for other types."""
        self.bounds: tuple[tuple[float, float], tuple[float, float]] | None = None
        """World x and y of the low and high corner of a ground from a file (m). None for other types."""
        self._holds_levels = False
        self._flat_patches: dict[str, torch.Tensor] = {}
        self._flat_patch_radii: dict[str, float] = {}
        if cfg.terrain_type != "plane":
            # Other terrains are colored by height, without the default material.
            added_only = dataclasses.replace(_GROUND_MATERIAL, geom_names_expr=None)
            materials = tuple(added_only if m == _GROUND_MATERIAL else m for m in cfg.materials)
            cfg = dataclasses.replace(cfg, materials=materials)
        super().__init__(cfg)

    def _make_spec(self) -> mujoco.MjSpec:
        kind = self.cfg.terrain_type
        check_one_of(
            "TerrainEntityCfg.terrain_type", kind, ("plane", "generator", "mesh", "heightmap")
        )
        spec = mujoco.MjSpec()
        if kind == "plane":
            body = spec.worldbody.add_body(name="terrain")
            body.add_geom(name="terrain", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 0.01))
            self.configure_env_origins()
        elif kind == "generator":
            self._generate(spec)
        else:
            self._read(spec, kind)
        if self.cfg.debug_vis:
            self._add_debug_sites(spec.body("terrain"))
        return spec

    def _generate(self, spec: mujoco.MjSpec) -> None:
        """Add the configured grid of sub-terrains and assign environments to it."""
        if self.cfg.terrain_generator is None:
            raise ValueError(
                "TerrainEntityCfg.terrain_generator: expected a TerrainGeneratorCfg for "
                "terrain_type 'generator', got None; use e.g. "
                "mjlab.terrains.config.ROUGH_TERRAINS_CFG."
            )
        generator = TerrainGenerator(self.cfg.terrain_generator, self._device)
        generator.compile(spec)
        self.terrain_generator = generator
        self._flat_patches = {
            name: torch.as_tensor(found, dtype=torch.float32, device=self._device)
            for name, found in generator.flat_patches.items()
        }
        self._flat_patch_radii = dict(generator.flat_patch_radii)
        # Without a curriculum a column mixes types, even if columns and types are equal in number.
        shares = generator.proportions if generator.cfg.curriculum else None
        self.configure_env_origins(generator.terrain_origins, shares)

    def _read(self, spec: mujoco.MjSpec, kind: Literal["mesh", "heightmap"]) -> None:
        """Add the configured ground and spread environments over it, as over cells of one level."""
        if self.cfg.terrain_file is None:
            raise ValueError(
                f"TerrainEntityCfg.terrain_file: expected a TerrainFileCfg for terrain_type {kind!r}, got "
                'None; use TerrainFileCfg(path="...").'
            )
        ground = add_ground(spec, self.cfg.terrain_file, kind)
        low, high = ground.low.tolist(), ground.high.tolist()
        self.bounds = ((low[0], low[1]), (high[0], high[1]))
        spacing = 2.0 if self.cfg.env_spacing is None else self.cfg.env_spacing
        self.configure_env_origins(ground.spawn_points(spacing, self.cfg.terrain_file.origins))

    def _add_debug_sites(self, body: mujoco.MjsBody) -> None:
        """Add sites `env_origin_<i>` (group 4), `terrain_origin_<r>_<c>` (group 5), and
        `flat_patch_<name>_<r>_<c>_<k>` (group 3)."""
        for index, place in enumerate(self.env_origins.tolist()):
            body.add_site(
                name=f"env_origin_{index}", type=_SPHERE, size=(0.3, 0.0, 0.0), pos=place, group=4,
                rgba=_GREEN,
            )  # fmt: skip
        origins = torch.zeros(0, 0, 3) if self.terrain_origins is None else self.terrain_origins
        for row, col in np.ndindex(origins.shape[:2]):
            body.add_site(
                name=f"terrain_origin_{row}_{col}", type=_SPHERE, size=(0.5, 0.0, 0.0),
                pos=origins[row, col].tolist(), group=5, rgba=_BLUE,
            )  # fmt: skip
        for name, patches in self._flat_patches.items():
            # MuJoCo rejects sites of size 0, and a patch may be a single point.
            radius = max(self._flat_patch_radii[name], _PATCH_HALF_HEIGHT)
            size = (radius, radius, _PATCH_HALF_HEIGHT)
            for row, col, k in np.ndindex(patches.shape[:3]):
                body.add_site(
                    name=f"flat_patch_{name}_{row}_{col}_{k}", type=_BOX, size=size,
                    pos=patches[row, col, k].tolist(), group=3, rgba=_YELLOW,
                )  # fmt: skip

    def _placeable(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        # The terrain has a fixed pose.
        return spec

    @property
    def flat_patches(self) -> dict[str, torch.Tensor]:
        """World positions of flat patches by name (m), (R, C, num_patches, 3). Empty on a plane."""
        return self._flat_patches

    @property
    def flat_patch_radii(self) -> dict[str, float]:
        """Radius of flat patches by name (m). Empty on a plane."""
        return self._flat_patch_radii

    def configure_env_origins(
        self,
        origins: np.ndarray | torch.Tensor | None = None,
        proportions: np.ndarray | None = None,
    ) -> None:
        """Reassign the origins of all environments.

        Args:
            origins: (R, C, 3) spawn points of a grid of R levels and C columns. Levels are sampled
                up to the configured maximum; each column gets a block of environments. None: grid
                on a plane.
            proportions: Share of environments per column. None, or a length other than C: equal
                shares. Use only if each column is a single terrain type, as in a curriculum.

        Raises:
            ValueError: `origins` and `cfg.env_spacing` are None.
        """
        num_envs = self.cfg.num_envs
        if origins is None:
            if self.cfg.env_spacing is None:
                raise ValueError(
                    "TerrainEntityCfg.env_spacing: expected a distance (m) for environments on a "
                    "plane, got None."
                )
            self.terrain_origins = self.terrain_levels = self.terrain_types = None
            self.max_terrain_level = 0
            self.env_origins = grid_origins(num_envs, self.cfg.env_spacing, self._device)
            return
        grid = torch.as_tensor(origins, dtype=torch.float32, device=self._device)
        num_rows, num_cols = grid.shape[:2]
        top = self.cfg.max_init_terrain_level
        num_initial = num_rows if top is None else min(top + 1, num_rows)
        self.terrain_origins = grid
        self.max_terrain_level = num_rows
        self.terrain_levels = torch.randint(0, num_initial, (num_envs,), device=self._device)
        self.terrain_types = assign_columns(num_envs, num_cols, proportions, self._device)
        self.env_origins = grid[self.terrain_levels, self.terrain_types]

    def update_env_origins(
        self, env_ids: torch.Tensor, move_up: torch.Tensor, move_down: torch.Tensor
    ) -> None:
        """Move environments up or down a level.

        Environments above the highest level get a random level; the lowest level is a lower bound.
        Columns do not change. Does nothing on a plane and inside `levels_held`.

        Args:
            env_ids: (k,) environments.
            move_up: (k,) mask of environments to move up.
            move_down: (k,) mask of environments to move down.
        """
        if self._holds_levels or self.terrain_origins is None or self.terrain_levels is None:
            return
        levels = self.terrain_levels[env_ids] + move_up.long() - move_down.long()
        # One draw per environment, so that the number of draws does not depend on results.
        drawn = torch.randint_like(levels, self.max_terrain_level)
        levels = torch.where(levels >= self.max_terrain_level, drawn, levels.clamp(min=0))
        self._go_to_levels(env_ids, levels)

    @contextmanager
    def levels_held(self) -> Generator[None]:
        """Disable `update_env_origins` inside this context, so that no curriculum changes levels.

        For evaluations: their results must not depend on previous evaluations.
        """
        held, self._holds_levels = self._holds_levels, True
        try:
            yield
        finally:
            self._holds_levels = held

    def set_levels(self, levels: torch.Tensor) -> None:
        """Move all environments to `levels` (N,) of their columns. Does nothing on a plane."""
        self._go_to_levels(torch.arange(self.cfg.num_envs, device=self._device), levels)

    def spread_levels(self, first: int = 0) -> None:
        """Distribute the environments evenly over all levels, whatever `max_init_terrain_level` is.

        Consecutive environments have different levels, so that each column is even too. Does nothing
        on a plane.

        Args:
            first: Number of environments distributed before, in earlier rounds.
        """
        num = self.max_terrain_level
        if num == 0:
            return
        # Coprime with the number of levels, and near the golden section: any few environments in
        # succession cover the levels.
        stride = next(k for k in range(round(0.618 * num), num + 1) if math.gcd(k, num) == 1)
        index = torch.arange(first, first + self.cfg.num_envs, device=self._device)
        self.set_levels(index * stride % num)

    def randomize_env_origins(self, env_ids: torch.Tensor) -> None:
        """Move environments to uniformly sampled cells. Does nothing on a plane."""
        if self.terrain_origins is None or self.terrain_types is None:
            return
        num_rows, num_cols = self.terrain_origins.shape[:2]
        count = (len(self.terrain_types[env_ids]),)
        levels = torch.randint(0, num_rows, count, device=self._device)
        self.terrain_types[env_ids] = torch.randint(0, num_cols, count, device=self._device)
        self._go_to_levels(env_ids, levels)

    def _go_to_levels(self, env_ids: torch.Tensor, levels: torch.Tensor) -> None:
        """Move environments to levels of their columns."""
        grid, kept, types = self.terrain_origins, self.terrain_levels, self.terrain_types
        if grid is not None and kept is not None and types is not None:
            kept[env_ids] = levels
            self.env_origins[env_ids] = grid[levels, types[env_ids]]


def grid_origins(num_envs: int, spacing: float, device: str) -> torch.Tensor:
    """Return origins (m) on a square grid centered on the world origin, (num_envs, 3).

    With `rows = ceil(N / floor(sqrt N))` and `cols = ceil(N / rows)`, environment k is in row
    `i = k div cols` and column `j = k mod cols`, at
    `(-(i - (rows - 1) / 2) s, (j - (cols - 1) / 2) s, 0)`.
    """
    num_rows = math.ceil(num_envs / math.isqrt(num_envs))
    num_cols = math.ceil(num_envs / num_rows)
    index = torch.arange(num_envs, device=device)
    row = torch.div(index, num_cols, rounding_mode="floor")
    origins = torch.zeros(num_envs, 3, dtype=torch.float32, device=device)
    origins[:, 0] = -(row - (num_rows - 1) / 2) * spacing
    origins[:, 1] = (index % num_cols - (num_cols - 1) / 2) * spacing
    return origins


def assign_columns(
    num_envs: int, num_cols: int, proportions: np.ndarray | None, device: str
) -> torch.Tensor:
    """Return terrain columns in contiguous blocks of environments, (num_envs,).

    With one proportion per column, block sizes are proportional: every column first gets one
    environment (if possible), and the rest is split by largest remainder. Otherwise blocks have
    equal size.
    """
    if proportions is None or len(proportions) != num_cols:
        index = torch.arange(num_envs, device=device)
        return torch.div(index * num_cols, num_envs, rounding_mode="floor")
    counts = torch.tensor(split_by_proportion(num_envs, np.asarray(proportions)), device=device)
    return torch.repeat_interleave(torch.arange(num_cols, device=device), counts)


def split_by_proportion(total: int, proportions: np.ndarray) -> list[int]:
    """Split `total` into counts per share: at least one each if possible, with sum `total`.

    Raises:
        ValueError: negative proportion, or all proportions zero.
    """
    proportions = np.asarray(proportions, dtype=np.float64)
    if (proportions < 0.0).any() or proportions.sum() <= 0.0:
        raise ValueError(
            f"Terrain proportions: expected values >= 0, not all 0, got {proportions.tolist()}."
        )
    shares = proportions / proportions.sum()
    counts = np.full(len(shares), 1 if total >= len(shares) else 0)
    exact = shares * (total - counts.sum())
    # Rounding must not push products such as 0.3 * 10 below the exact integer.
    whole = np.floor(exact + 1e-9).astype(int)
    counts += whole
    left_over = total - int(counts.sum())
    if left_over > 0:
        largest = np.argsort(exact - whole, kind="stable")[-left_over:]
        counts[largest] += 1
    return counts.tolist()
