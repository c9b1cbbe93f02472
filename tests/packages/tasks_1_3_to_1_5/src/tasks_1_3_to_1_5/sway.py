"""Swaying after a motion command that shares nothing with the interface's but its name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.managers import (
    ActionTerm,
    ActionTermCfg,
    CommandTerm,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

from .make_motion import MOTION


def get_pendulum_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "pendulum.xml"))


class Recording:
    """Recording as the export of tracking policies reads it."""

    def __init__(self, path: Path, device: str):
        content = np.load(path)
        for name in (
            "joint_pos",
            "joint_vel",
            "body_pos_w",
            "body_quat_w",
            "body_lin_vel_w",
            "body_ang_vel_w",
        ):
            value = torch.tensor(content[name], dtype=torch.float32, device=device)
            setattr(self, name, value)
        self.time_step_total = len(self.joint_pos)


class SwayCommand(CommandTerm):
    """Hip and knee positions of the recording, (N, 2)."""

    def __init__(self, cfg: SwayCommandCfg, env):
        super().__init__(cfg, env)
        self.motion = Recording(Path(cfg.motion_file), self.device)
        self.frame = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return self.motion.joint_pos[self.frame]

    def _update_metrics(self) -> None:
        pass

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self.frame[env_ids] = 0

    def _update_command(self) -> None:
        self.frame = (self.frame + 1) % self.motion.time_step_total


# Fields without defaults after inherited ones: the bases take keywords only.
@dataclass
class SwayCommandCfg(CommandTermCfg):
    motion_file: str
    anchor_body_name: str
    body_names: tuple[str, ...]

    def build(self, env) -> SwayCommand:
        return SwayCommand(self, env)


class CommonTarget(ActionTerm):
    """Action of one number, the position target of all joints."""

    def __init__(self, cfg: CommonTargetCfg, env):
        super().__init__(cfg, env)
        self._raw = torch.zeros(self.num_envs, 1, device=self.device)

    @property
    def action_dim(self) -> int:
        return 1

    @property
    def raw_action(self) -> torch.Tensor:
        return self._raw

    def process_actions(self, actions: torch.Tensor) -> None:
        self._raw[:] = actions

    def apply_actions(self) -> None:
        # (N, 1) is for every joint.
        self._entity.set_joint_position_target(self.cfg.reach * self._raw)

    def reset(self, env_ids=None) -> None:
        self._raw[env_ids] = 0.0


@dataclass
class CommonTargetCfg(ActionTermCfg):
    reach: float

    def build(self, env) -> CommonTarget:
        return CommonTarget(self, env)


def reset_joints_together(env, env_ids: torch.Tensor, spread: float) -> None:
    position = spread * (torch.rand(len(env_ids), 1, device=env.device) - 0.5)
    env.scene["robot"].write_joint_state_to_sim(
        position, torch.zeros_like(position), env_ids=env_ids
    )
    both = env.scene["robot"].data.joint_pos[env_ids]
    assert torch.equal(both, position.expand_as(both))


def tilt_gravity(env, env_ids: torch.Tensor, spread: float) -> None:
    """Set the gravity of environments, without expanding the field."""
    gravity = torch.zeros(len(env_ids), 3, device=env.device)
    gravity[:, 0] = spread * (torch.rand(len(env_ids), device=env.device) - 0.5)
    gravity[:, 2] = -9.81
    env.sim.model.opt.gravity[env_ids] = gravity


def follow(env, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    error = env.command_manager.get_command("motion") - env.scene[asset_cfg.name].data.joint_pos
    return torch.exp(-torch.square(error).sum(dim=-1))


def spread_so_far(env, env_ids) -> torch.Tensor:
    return env.command_manager.get_term("motion").frame.float().mean()


def sway_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    actuator = BuiltinPositionActuatorCfg(
        target_names_expr=("hip", "knee"), stiffness=20.0, damping=1.0
    )
    terms = {
        "joint_pos": ObservationTermCfg(mdp.joint_pos_rel),
        "joint_vel": ObservationTermCfg(mdp.joint_vel_rel, {}, None, (-50.0, 50.0), 0.1),
        "motion": ObservationTermCfg(mdp.generated_commands, {"command_name": "motion"}),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=1e9 if play else 2.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={
                "robot": EntityCfg(
                    spec_fn=get_pendulum_spec,
                    articulation=EntityArticulationInfoCfg((actuator,)),
                )
            },
        ),
        observations={
            "actor": ObservationGroupCfg(terms, True, -1, not play),
            "critic": ObservationGroupCfg(dict(terms)),
        },
        actions={"common": CommonTargetCfg(entity_name="robot", reach=0.5)},
        commands={
            "motion": SwayCommandCfg(
                resampling_time_range=(1e9, 1e9),
                motion_file=str(MOTION),
                anchor_body_name="thigh",
                body_names=("thigh", "shank"),
            )
        },
        events={
            "reset": EventTermCfg(func=reset_joints_together, mode="reset", params={"spread": 0.2}),
            "gravity": EventTermCfg(func=tilt_gravity, mode="reset", params={"spread": 1.0}),
        },
        rewards={
            "follow": RewardTermCfg(
                func=follow, weight=1.0, params={"asset_cfg": SceneEntityCfg("robot", (".*",))}
            )
        },
        curriculum={"frame": CurriculumTermCfg(spread_so_far)},
        terminations={"time_out": TerminationTermCfg(mdp.time_out, {}, True)},
        sim=SimulationCfg(mujoco=MujocoCfg(0.005)),
    )
