"""An arm whose hand follows a goal, moved by differential inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import (
    DifferentialIKAction,
    DifferentialIKActionCfg,
    JointPositionActionCfg,
)
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    MetricsTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RecorderTerm,
    RecorderTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.velocity.rl import VelocityOnPolicyRunner
from mjlab.terrains import TerrainEntityCfg
from mjlab.utils.spec_config import CollisionCfg


def get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "arm.xml"))


_ARM = EntityCfg(
    spec_fn=get_spec,
    init_state=EntityCfg.InitialStateCfg(
        joint_pos={"shoulder": -0.5, "elbow": 1.0, "wrist": 0.0}, joint_vel={".*": 0.0}
    ),
    # The motor of the XML stays on the wrist, and both act.
    articulation=EntityArticulationInfoCfg(
        actuators=(
            BuiltinPositionActuatorCfg(
                target_names_expr=("shoulder", "elbow", "wrist"), stiffness=30.0, damping=2.0
            ),
        )
    ),
    # Geoms that no pattern names keep 1 and 1.
    collisions=(
        CollisionCfg(
            geom_names_expr=(".*_link", "hand"),
            contype={"upper_link": 2},
            conaffinity={"upper_link": 2},
        ),
    ),
)


class ReachCommand(CommandTerm):
    """Position of the tip to reach, (N, 3)."""

    cfg: ReachCommandCfg

    def __init__(self, cfg: ReachCommandCfg, env):
        super().__init__(cfg, env)
        self.goal = torch.zeros(self.num_envs, 3, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return self.goal

    def _update_metrics(self) -> None:
        pass

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        low = torch.tensor(self.cfg.low, device=self.device)
        high = torch.tensor(self.cfg.high, device=self.device)
        goal = low + (high - low) * torch.rand(len(env_ids), 3, device=self.device)
        self.goal[env_ids] = goal + self._env.scene.env_origins[env_ids]

    def _update_command(self) -> None:
        pass


@dataclass(kw_only=True)
class ReachCommandCfg(CommandTermCfg):
    low: tuple[float, float, float] = (0.2, 0.0, 0.2)
    high: tuple[float, float, float] = (0.5, 0.0, 0.5)

    def build(self, env) -> ReachCommand:
        return ReachCommand(self, env)


class OffsetIKAction(DifferentialIKAction):
    """Inverse kinematics for a point ahead of the tip."""

    cfg: OffsetIKActionCfg
    frames_read = 0

    def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        self.frames_read += 1
        position, orientation = super()._get_frame_pose()
        return position + torch.tensor(self.cfg.offset, device=position.device), orientation

    @property
    def num_driven_joints(self) -> int:
        return len(self._joint_ids)


@dataclass(kw_only=True)
class OffsetIKActionCfg(DifferentialIKActionCfg):
    offset: tuple[float, float, float] = (0.02, 0.0, 0.0)

    def build(self, env) -> OffsetIKAction:
        return OffsetIKAction(self, env)


class TipRecorder(RecorderTerm):
    """Recorder that counts the steps and the resets."""

    def __init__(self, cfg: RecorderTermCfg, env):
        super().__init__(cfg, env)
        self.steps = self.resets = 0

    def record_post_step(self) -> None:
        self.steps += 1

    def record_pre_reset(self, env_ids: torch.Tensor) -> None:
        self.resets += len(env_ids)


def _distance(env) -> torch.Tensor:
    tip, _ = env.scene["robot"].find_sites("tip")
    position = env.scene["robot"].data.site_pos_w[:, tip].squeeze(1)
    return torch.norm(env.command_manager.get_command("reach") - position, dim=-1)


def reach(env, std: float) -> torch.Tensor:
    return torch.exp(-torch.square(_distance(env) / std))


def frame_offset_used(env) -> torch.Tensor:
    """Return 1 once the action has asked for its frame; how packages check their overrides."""
    action = env.action_manager.get_term("ik")
    assert action.num_driven_joints == 2
    return torch.full((env.num_envs,), float(action.frames_read > 0), device=env.device)


def steps_counted(env) -> torch.Tensor:
    """Return the steps of the episode, as the metrics count them, (N, 1)."""
    steps = env.metrics_manager._step_count if hasattr(env, "metrics_manager") else None
    if steps is None:
        return torch.zeros(env.num_envs, 1, device=env.device)
    assert set(env.metrics_manager._episode_sums) == {"frame_offset"}
    return steps[:, None].float()


def truncated_now(env) -> torch.Tensor:
    """Return 1 where the episode ran out of time in this step."""
    assert len(env.observation_manager._group_obs_term_cfgs["actor"]) == 4
    return env.termination_manager._truncated_buf.float()


def hand_hit_base(env) -> torch.Tensor:
    """Return True where the sensor's first slot is in contact."""
    sensor = env.scene["hand_contact"]
    assert len(sensor._slots) == 2
    return sensor.data.found[:, 0] > 0


def arm_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    terms = {
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        "goal": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "reach"}),
        "steps": ObservationTermCfg(func=steps_counted),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=1e9 if play else 0.1,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={"robot": _ARM},
            sensors=(
                ContactSensorCfg(
                    name="hand_contact",
                    primary=ContactMatch(
                        mode="geom", pattern=("hand", "lower_link"), entity="robot"
                    ),
                    secondary=ContactMatch(mode="geom", pattern="base", entity="robot"),
                    fields=("found",),
                ),
            ),
        ),
        observations={
            "actor": ObservationGroupCfg(terms=terms, concatenate_terms=True),
            "critic": ObservationGroupCfg(terms=dict(terms), concatenate_terms=True),
        },
        actions={
            "ik": OffsetIKActionCfg(
                entity_name="robot",
                actuator_names=("shoulder", "elbow"),
                frame_type="site",
                frame_name="tip",
                orientation_weight=0.0,
                delta_pos_scale=0.05,
            ),
            "wrist": JointPositionActionCfg(
                entity_name="robot", actuator_names=("wrist",), scale=0.5
            ),
        },
        commands={"reach": ReachCommandCfg(resampling_time_range=(1.0, 2.0))},
        events={
            "reset": EventTermCfg(
                func=mdp.reset_joints_by_offset,
                mode="reset",
                params={
                    "position_range": (-0.2, 0.2),
                    "velocity_range": (0.0, 0.0),
                    "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",)),
                },
            )
        },
        rewards={
            "reach": RewardTermCfg(func=reach, weight=1.0, params={"std": 0.3}),
            "truncated": RewardTermCfg(func=truncated_now, weight=-0.1),
        },
        metrics={"frame_offset": MetricsTermCfg(func=frame_offset_used)},
        recorders={"tip": RecorderTermCfg(func=TipRecorder)},
        terminations={
            "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
            "hand_hit_base": TerminationTermCfg(func=hand_hit_base),
        },
        sim=SimulationCfg(nconmax=20, njmax=60, mujoco=MujocoCfg(timestep=0.005)),
    )


class ArmRunner(VelocityOnPolicyRunner):
    """Runner that puts the exported policy into a folder of its own."""

    @staticmethod
    def _get_export_paths(checkpoint_path: str) -> tuple[Path, str, Path]:
        folder = Path(checkpoint_path).parent / "exported"
        folder.mkdir(parents=True, exist_ok=True)
        return folder, "arm.onnx", folder / "arm.onnx"

    def learn(self, *args, **kwargs) -> None:
        super().learn(*args, **kwargs)
        if self.logger.logger_type == "tensorboard":
            exported = Path(self.logger.log_dir) / "exported" / "arm.onnx"
            assert exported.exists(), f"expected the exported policy at {exported}"
