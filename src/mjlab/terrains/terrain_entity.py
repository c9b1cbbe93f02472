"""The ground, and where on it the environments are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import mujoco
import numpy as np
import torch

from mjlab.entity import Entity, EntityCfg
from mjlab.terrains.origins import assign_columns, grid_origins
from mjlab.utils import spec_config as spec_cfg

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
    """Describes the ground. `SceneCfg.terrain` takes it."""

    lights: tuple[spec_cfg.LightCfg, ...] = (_SUN,)
    """Lights to add."""
    textures: tuple[spec_cfg.TextureCfg, ...] = (_GROUND_TEXTURE,)
    """Textures to add."""
    materials: tuple[spec_cfg.MaterialCfg, ...] = (_GROUND_MATERIAL,)
    """Materials to add and to give to geoms."""
    terrain_type: Literal["generator", "plane"] = "plane"
    """`plane` is one infinite plane; `generator` makes a grid of sub-terrains."""
    terrain_generator: Any | None = None
    """What `generator` makes."""
    env_spacing: float | None = 2.0
    """Distance between environments on a plane, in metres. A scene puts its own here."""
    max_init_terrain_level: int | None = None
    """Highest level (row) of a generated terrain at which environments start; None for all."""
    num_envs: int = 1
    """Number of environments. A scene puts its own here."""
    debug_vis: bool = False
    """Whether to add sites that show where environments start."""

    def build(self) -> NoReturn:
        """Not offered, because a terrain also needs a device: use `TerrainEntity(cfg, device)`."""
        raise TypeError(
            "TerrainEntityCfg.build() cannot know the device. Set SceneCfg.terrain, or call "
            "TerrainEntity(cfg, device)."
        )


class TerrainEntity(Entity):
    """The ground: one static body `terrain` of the world, and the environments' origins."""

    _transient = {"_device"}

    cfg: TerrainEntityCfg

    def __init__(self, cfg: TerrainEntityCfg, device: str) -> None:
        """Build the ground and place the environments on it.

        Raises:
            ValueError: the config makes no sense, or asks for what is not available.
        """
        self._device = device
        self.env_origins = torch.zeros(cfg.num_envs, 3, device=device)
        """(N, 3) world positions of the environments' origins."""
        self.terrain_origins: torch.Tensor | None = None
        """(R, C, 3) spawn points of a grid of R levels and C columns; None on a plane."""
        self.terrain_levels: torch.Tensor | None = None
        """(N,) level (row) of each environment; None on a plane."""
        self.terrain_types: torch.Tensor | None = None
        """(N,) column of each environment; None on a plane."""
        self.max_terrain_level = 0
        """Number of levels; 0 on a plane."""
        self._flat_patches: dict[str, torch.Tensor] = {}
        self._flat_patch_radii: dict[str, float] = {}
        super().__init__(cfg)

    def _make_spec(self) -> mujoco.MjSpec:
        if self.cfg.terrain_type == "plane":
            return self._make_plane()
        if self.cfg.terrain_type == "generator":
            raise ValueError(
                "TerrainEntityCfg.terrain_type='generator' is not available in this release. Use "
                "terrain_type='plane'."
            )
        raise ValueError(
            f"TerrainEntityCfg.terrain_type is {self.cfg.terrain_type!r}; it must be 'plane' or "
            "'generator'."
        )

    def _make_plane(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="terrain")
        body.add_geom(name="terrain", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 0.01))
        self.configure_env_origins()
        if self.cfg.debug_vis:
            self._add_debug_sites(body)
        return spec

    def _placeable(self, spec: mujoco.MjSpec) -> mujoco.MjSpec:
        # The ground stays where it is.
        return spec

    @property
    def flat_patches(self) -> dict[str, torch.Tensor]:
        """Flat spots by name, (R, C, number, 3) world positions; none on a plane."""
        return self._flat_patches

    @property
    def flat_patch_radii(self) -> dict[str, float]:
        """Radius of the flat spots by name, in metres; none on a plane."""
        return self._flat_patch_radii

    def configure_env_origins(
        self,
        origins: np.ndarray | torch.Tensor | None = None,
        proportions: np.ndarray | None = None,
    ) -> None:
        """Place all environments anew.

        Args:
            origins: (R, C, 3) spawn points of a grid of R levels and C columns. Levels are drawn
                at random, up to the configured one; columns get blocks of environments. None lays
                the environments out on a plane.
            proportions: Share of the environments for each column; None, or another number of
                them than there are columns, shares equally. Pass them only where each column is
                one kind of terrain, as in a curriculum.

        Raises:
            ValueError: `origins` has another shape, or is None without a configured spacing.
        """
        num_envs = self.cfg.num_envs
        if origins is None:
            if self.cfg.env_spacing is None:
                raise ValueError(
                    "TerrainEntityCfg.env_spacing is None, but the environments are laid out on a "
                    "plane. Give the distance between them, in metres."
                )
            self.terrain_origins = self.terrain_levels = self.terrain_types = None
            self.max_terrain_level = 0
            self.env_origins = grid_origins(num_envs, self.cfg.env_spacing, self._device)
            return
        grid = torch.as_tensor(origins, dtype=torch.float32, device=self._device)
        if grid.ndim != 3 or grid.shape[2] != 3 or 0 in grid.shape:
            raise ValueError(
                f"origins has the shape {tuple(grid.shape)}; it must be (levels, columns, 3)."
            )
        num_rows, num_cols = grid.shape[:2]
        top = num_rows - 1
        if self.cfg.max_init_terrain_level is not None:
            top = min(self.cfg.max_init_terrain_level, top)
        self.terrain_origins = grid
        self.max_terrain_level = num_rows
        self.terrain_levels = torch.randint(0, top + 1, (num_envs,), device=self._device)
        self.terrain_types = assign_columns(num_envs, num_cols, proportions, self._device)
        self.env_origins = grid[self.terrain_levels, self.terrain_types]

    def update_env_origins(
        self, env_ids: torch.Tensor, move_up: torch.Tensor, move_down: torch.Tensor
    ) -> None:
        """Move environments up or down a level; nothing on a plane.

        Those that pass the highest level go to a random one, and none go below the lowest. The
        column of an environment never changes here.

        Args:
            env_ids: (k,) environments.
            move_up: (k,) whether each goes up.
            move_down: (k,) whether each goes down.
        """
        if self.terrain_origins is None or self.terrain_levels is None:
            return
        levels = self.terrain_levels[env_ids] + move_up.long() - move_down.long()
        # One draw for every environment, so that how many are drawn does not depend on results.
        drawn = torch.randint_like(levels, self.max_terrain_level)
        levels = torch.where(levels >= self.max_terrain_level, drawn, levels.clamp(min=0))
        self._go_to_levels(env_ids, levels)

    def randomize_env_origins(self, env_ids: torch.Tensor) -> None:
        """Move environments to cells drawn uniformly; nothing on a plane."""
        if self.terrain_origins is None or self.terrain_types is None:
            return
        num_rows, num_cols = self.terrain_origins.shape[:2]
        count = (len(self.terrain_types[env_ids]),)
        levels = torch.randint(0, num_rows, count, device=self._device)
        self.terrain_types[env_ids] = torch.randint(0, num_cols, count, device=self._device)
        self._go_to_levels(env_ids, levels)

    def _go_to_levels(self, env_ids: torch.Tensor, levels: torch.Tensor) -> None:
        """Put environments on levels of their columns."""
        grid, kept, types = self.terrain_origins, self.terrain_levels, self.terrain_types
        if grid is not None and kept is not None and types is not None:
            kept[env_ids] = levels
            self.env_origins[env_ids] = grid[levels, types[env_ids]]

    def _add_debug_sites(self, body: mujoco.MjsBody) -> None:
        for index, position in enumerate(self.env_origins.tolist()):
            body.add_site(
                name=f"env_origin_{index}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(0.3, 0.0, 0.0),
                pos=position,
                group=4,
                rgba=(0.2, 0.6, 0.2, 0.3),
            )
