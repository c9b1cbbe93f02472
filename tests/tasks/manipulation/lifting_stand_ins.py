"""Stand-ins for an environment, with only the attributes that terms read and known values."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import torch

from mjlab.tasks.manipulation.mdp import (
    LiftingCommand,
    LiftingCommandCfg,
    MultiCubeLiftingCommand,
    MultiCubeLiftingCommandCfg,
)

ORIGIN_STEP = 3.0


class Object:
    """Object at the pose last written, by the command or by a test."""

    def __init__(self, num_envs: int, geom_ids: list[int]) -> None:
        self.indexing = SimpleNamespace(geom_ids=torch.tensor(geom_ids))
        self.data = SimpleNamespace(root_link_pos_w=torch.zeros(num_envs, 3))
        self.pose = torch.zeros(num_envs, 7)
        self.velocity = torch.full((num_envs, 6), torch.nan)

    def write_root_link_pose_to_sim(self, pose: torch.Tensor, env_ids: torch.Tensor) -> None:
        self.pose[env_ids] = pose

    def write_root_link_velocity_to_sim(
        self, velocity: torch.Tensor, env_ids: torch.Tensor
    ) -> None:
        self.velocity[env_ids] = velocity


class Simulation:
    """Stand-in for `forward`: updates object positions and records the environments."""

    def __init__(self, objects: dict[str, Object], num_envs: int, geoms: int) -> None:
        self.objects = objects
        self.forwarded: list[list[int] | None] = []
        self.mj_model = cubes_model(geoms)
        radii = torch.tensor(self.mj_model.geom_rbound, dtype=torch.float)
        self.model = SimpleNamespace(
            geom_pos=torch.zeros(num_envs, geoms, 3), geom_rbound=radii.expand(num_envs, -1)
        )
        self.absent_geoms = None

    def forward(self, env_ids: torch.Tensor | None = None) -> None:
        self.forwarded.append(None if env_ids is None else env_ids.tolist())
        rows = slice(None) if env_ids is None else env_ids
        for one in self.objects.values():
            one.data.root_link_pos_w[rows] = one.pose[rows, :3]


class StandInEnv:
    """N environments with objects, 3 m apart."""

    def __init__(self, num_envs: int = 4, **objects: Object) -> None:
        self.num_envs, self.device, self.step_dt = num_envs, "cpu", 0.02
        self.objects = objects or {"cube": Object(num_envs, [0])}
        self.scene: Any = dict(self.objects)
        self.scene = SceneStandIn(self.objects, num_envs)
        geoms = 1 + max(int(one.indexing.geom_ids.max()) for one in self.objects.values())
        self.sim = Simulation(self.objects, num_envs, geoms)
        self.command_manager = SimpleNamespace(get_term=lambda name: self.command)
        self.command: Any = None


class SceneStandIn(dict):
    def __init__(self, objects: dict[str, Object], num_envs: int) -> None:
        super().__init__(objects)
        self.entities = objects
        self.sensors: dict[str, Any] = {}
        self.env_origins = torch.zeros(num_envs, 3)
        self.env_origins[:, 0] = ORIGIN_STEP * torch.arange(num_envs)


def cubes_model(count: int) -> mujoco.MjModel:
    """Return a model of `count` cubes of 4 cm."""
    spec = mujoco.MjSpec()
    for _ in range(count):
        body = spec.worldbody.add_body()
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.02,) * 3, mass=0.05)
    return spec.compile()


def lifting_command(env: StandInEnv | None = None, **fields: Any) -> tuple[StandInEnv, Any]:
    """Return a stand-in and a lifting command for its cube."""
    env = env or StandInEnv()
    cfg = LiftingCommandCfg(
        entity_name=fields.pop("entity_name", "cube"),
        resampling_time_range=fields.pop("resampling_time_range", (8.0, 12.0)),
        **fields,
    )
    env.command = LiftingCommand(cfg, env)  # ty: ignore[invalid-argument-type]
    return env, env.command


def cubes(count: int = 3, num_envs: int = 4) -> StandInEnv:
    """Return a stand-in with cubes of one geom each."""
    objects = {f"cube_{index}": Object(num_envs, [index]) for index in range(count)}
    return StandInEnv(num_envs, **objects)


def multi_cube_command(env: StandInEnv | None = None, **fields: Any) -> tuple[StandInEnv, Any]:
    """Return a stand-in and a command for one of its cubes."""
    env = env or cubes()
    cfg = MultiCubeLiftingCommandCfg(
        entity_names=fields.pop("entity_names", tuple(env.objects)),
        resampling_time_range=fields.pop("resampling_time_range", (8.0, 12.0)),
        **fields,
    )
    env.command = MultiCubeLiftingCommand(cfg, env)  # ty: ignore[invalid-argument-type]
    return env, env.command
