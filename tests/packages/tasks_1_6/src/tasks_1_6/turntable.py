"""A turntable that points its arm in the commanded direction."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from rsl_rl.algorithms import PPO

from mjlab.actuator import BuiltinPdActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp import dr
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers import (
    CommandTerm,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RecorderTerm,
    RecorderTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.rl import (
    MjlabOnPolicyRunner,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainEntityCfg
from mjlab.utils.lab_api import math as math_utils
from mjlab.utils.spec_config import CollisionCfg
from mjlab.utils.wrappers import VideoRecorder


def get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "turntable.xml"))


class HeadingCommand(CommandTerm):
    """Direction to point in, as cosine and sine, (N, 2); it turns at a constant rate."""

    cfg: HeadingCommandCfg

    def __init__(self, cfg: HeadingCommandCfg, env):
        super().__init__(cfg, env)
        self.heading = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self) -> torch.Tensor:
        return torch.stack([self.heading.cos(), self.heading.sin()], dim=-1)

    def compute(self, dt: float | torch.Tensor, env_ids: torch.Tensor | None = None) -> None:
        super().compute(dt, env_ids)

    def _update_metrics(self) -> None:
        pass

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        drawn = torch.rand(len(env_ids), device=self.device)
        self.heading[env_ids] = 2.0 * math.pi * drawn

    def _update_command(self, env_ids: torch.Tensor | None = None) -> None:
        rows = slice(None) if env_ids is None else env_ids
        self.heading[rows] += self.cfg.rate * self._env.step_dt


@dataclass(kw_only=True)
class HeadingCommandCfg(CommandTermCfg):
    rate: float = 0.5

    def build(self, env) -> HeadingCommand:
        return HeadingCommand(self, env)


class PointRecorder(RecorderTerm):
    """Recorder that, unlike other terms, is not to be called."""

    def __init__(self, cfg: RecorderTermCfg, env):
        super().__init__(cfg, env)
        with contextlib.suppress(NotImplementedError):
            self()
            raise AssertionError("a recorder term was called and returned")


@torch.jit.script
def tip_direction(quat: torch.Tensor) -> torch.Tensor:
    """Return the direction of the arm, (N, 3)."""
    axis = torch.zeros_like(quat[..., :3])
    axis[..., 0] = 1.0
    return math_utils.quat_apply(quat, axis)


def arm_direction(env) -> torch.Tensor:
    robot = env.scene["robot"]
    arm = robot.body_names.index("arm")
    return tip_direction(robot.data.body_link_quat_w[:, arm])


def pointing(env, command_name: str, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    angle = env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids].squeeze(-1)
    command = env.command_manager.get_command(command_name)
    return angle.cos() * command[:, 0] + angle.sin() * command[:, 1]


def share_of_return(env, env_ids: torch.Tensor, reward_name: str) -> torch.Tensor:
    """Return the mean of a reward per second, which curricula compare with a threshold."""
    sums = env.reward_manager._episode_sums[reward_name]
    return torch.mean(sums[env_ids]) / env.max_episode_length_s


def turntable_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    terms = {
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        "direction": ObservationTermCfg(func=arm_direction),
        "heading": ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": "heading"}
        ),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=1e9 if play else 3.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={
                "robot": EntityCfg(
                    spec_fn=get_spec,
                    articulation=EntityArticulationInfoCfg(
                        actuators=(
                            BuiltinPdActuatorCfg(
                                target_names_expr=("turn", "lift"),
                                stiffness=5.0,
                                damping=0.5,
                                effort_limit=4.0,
                            ),
                        )
                    ),
                    collisions=(
                        CollisionCfg(
                            geom_names_expr=("table", "arm"),
                            contype=1,
                            conaffinity=0,
                            condim={"arm": 1, ".*": 3},
                            priority=0,
                        ),
                    ),
                )
            },
        ),
        observations={
            "actor": ObservationGroupCfg(terms=terms, enable_corruption=not play),
            "critic": ObservationGroupCfg(terms=dict(terms)),
        },
        actions={
            "joints": JointPositionActionCfg(
                entity_name="robot", actuator_names=(".*",), scale={"turn": 3.0, "lift": 0.5}
            )
        },
        commands={"heading": HeadingCommandCfg(resampling_time_range=(1.0, 2.0))},
        events={
            "gains": EventTermCfg(
                func=dr.pd_gains,
                mode="reset",
                params={
                    "kp_range": (0.9, 1.1),
                    "kd_range": (0.9, 1.1),
                    "asset_cfg": SceneEntityCfg("robot"),
                },
            )
        },
        rewards={
            "pointing": RewardTermCfg(
                func=pointing,
                weight=1.0,
                params={
                    "command_name": "heading",
                    "asset_cfg": SceneEntityCfg("robot", joint_names=("turn",)),
                },
            )
        },
        curriculum={
            "pointing": CurriculumTermCfg(func=share_of_return, params={"reward_name": "pointing"})
        },
        recorders={"point": RecorderTermCfg(func=PointRecorder)},
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
        sim=SimulationCfg(nconmax=10, njmax=40, mujoco=MujocoCfg(timestep=0.005)),
    )


class _TwoViews:
    """Environment whose image is one for each of two cameras, (2, H, W, 3)."""

    render_mode = "rgb_array"

    def __init__(self, env):
        self.unwrapped = env

    def __getattr__(self, name: str):
        return getattr(self.unwrapped, name)

    def render(self) -> np.ndarray:
        return np.zeros((2, 32, 48, 3), dtype=np.uint8)


class PointRunner(MjlabOnPolicyRunner):
    """Runner that records a video of two views once it has learned."""

    def learn(self, *args, **kwargs) -> None:
        super().learn(*args, **kwargs)
        env = self.env.unwrapped
        folder = Path(self.logger.log_dir) / "views"
        recorder = VideoRecorder(
            _TwoViews(env), folder, step_trigger=lambda step: step == 0, video_length=3
        )
        recorder.reset()
        for _ in range(4):
            recorder.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))
        assert list(folder.glob("*.mp4")), "no video was written"


class PointPPO(PPO):
    """PPO with the arguments of this release, and a learning rate that never changes."""

    def __init__(
        self,
        actor,
        critic,
        storage,
        num_learning_epochs=5,
        num_mini_batches=4,
        clip_param=0.2,
        gamma=0.99,
        lam=0.95,
        value_loss_coef=1.0,
        entropy_coef=0.01,
        learning_rate=1e-3,
        max_grad_norm=1.0,
        optimizer="adam",
        use_clipped_value_loss=True,
        schedule="adaptive",
        desired_kl=0.01,
        normalize_advantage_per_mini_batch=False,
        device="cpu",
        rnd_cfg=None,
        symmetry_cfg=None,
        multi_gpu_cfg=None,
    ):
        super().__init__(
            actor,
            critic,
            storage,
            num_learning_epochs=num_learning_epochs,
            num_mini_batches=num_mini_batches,
            entropy_coef=entropy_coef,
            learning_rate=learning_rate,
            schedule="fixed",
            device=device,
            rnd_cfg=rnd_cfg,
            symmetry_cfg=symmetry_cfg,
            multi_gpu_cfg=multi_gpu_cfg,
        )


def turntable_rl_cfg() -> RslRlOnPolicyRunnerCfg:
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(16,),
            obs_normalization=True,
            distribution_cfg={
                "class_name": "GaussianDistribution",
                "init_std": 1.0,
                "std_type": "scalar",
            },
        ),
        critic=RslRlModelCfg(hidden_dims=(16,), obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(
            num_mini_batches=1, class_name="tasks_1_6.turntable:PointPPO"
        ),
        experiment_name="tasks_1_6_turntable",
    )
