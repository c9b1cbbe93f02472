"""Stand-ins for an environment with only the data that terms read, for values known by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch

from mjlab.tasks.velocity.mdp import UniformVelocityCommand, UniformVelocityCommandCfg

Ranges = UniformVelocityCommandCfg.Ranges


def yaw_quat(angle: torch.Tensor) -> torch.Tensor:
    """Return rotations about z, (N, 4)."""
    zero = torch.zeros_like(angle)
    return torch.stack((torch.cos(angle / 2), zero, zero, torch.sin(angle / 2)), dim=1)


class StandInEnv:
    """N environments of a robot at a state set by the test."""

    def __init__(self, num_envs: int = 2, **sensors: Any) -> None:
        self.num_envs = num_envs
        self.device = "cpu"
        self.step_dt, self.common_step_counter = 0.02, 0
        self.extras: dict[str, Any] = {}
        self.data = SimpleNamespace(
            root_link_pos_w=torch.zeros(num_envs, 3),
            root_link_quat_w=yaw_quat(torch.zeros(num_envs)),
            root_link_lin_vel_b=torch.zeros(num_envs, 3),
            root_link_ang_vel_b=torch.zeros(num_envs, 3),
        )
        self.robot = SimpleNamespace(data=self.data, num_bodies=1, body_names=("trunk",))
        self.scene: Any = _Scene(robot=self.robot, **sensors)
        self.commands: dict[str, torch.Tensor] = {}
        self.command_manager = SimpleNamespace(
            get_command=self.commands.__getitem__, active_terms=["twist"]
        )

    def command(self, *rows: tuple[float, float, float]) -> StandInEnv:
        """Set the command of each environment."""
        self.commands["twist"] = torch.tensor(rows)
        return self


class _Scene(dict):
    def __init__(self, robot: Any, **sensors: Any) -> None:
        super().__init__(robot=robot, **sensors)
        self.entities = {"robot": robot}
        self.sensors = sensors
        self.terrain = None


def contacts(**data: Any) -> Any:
    """Return a contact sensor with these data; `landed` is what it says of first contacts."""
    landed = data.pop("landed", None)
    fields = {"found": None, "force": None, "force_history": None, "current_air_time": None}
    num_feet = next(iter(data.values())).shape[1]
    return SimpleNamespace(
        data=SimpleNamespace(**{**fields, **data}),
        primary_names=[f"foot_{i}" for i in range(num_feet)],
        compute_first_contact=lambda dt: landed,
    )


def velocity_command(
    env: StandInEnv | None = None, **fields: Any
) -> tuple[StandInEnv, UniformVelocityCommand]:
    """Return a stand-in and a velocity command for it; ranges are wide unless given."""
    env = env or StandInEnv(num_envs=8)
    ranges = fields.pop("ranges", {})
    headings = (-3.0, 3.0) if fields.get("heading_command") else None
    chosen = {
        "lin_vel_x": (-2.0, 1.0),
        "lin_vel_y": (-0.5, 0.7),
        "ang_vel_z": (-0.4, 0.9),
        "heading": headings,
        **ranges,
    }
    cfg = UniformVelocityCommandCfg(
        entity_name="robot",
        resampling_time_range=fields.pop("resampling_time_range", (1.0, 2.0)),
        ranges=Ranges(**chosen),
        **fields,
    )
    term = UniformVelocityCommand(cfg, env)  # ty: ignore[invalid-argument-type]
    return env, term
