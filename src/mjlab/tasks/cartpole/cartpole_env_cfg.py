"""Cartpole tasks: swing up a pole by pushing its cart, or balance the pole.

A cart slides on a rail and carries a pole on a hinge; the action is the force on the cart. Model and
reward are those of the DeepMind Control Suite (Tassa et al., 2018, https://arxiv.org/abs/1801.00690).
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import (
    JointEffortActionCfg,
    joint_pos_rel,
    joint_vel_rel,
    reset_joints_by_offset,
    time_out,
)
from mjlab.managers import (
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlBaseRunnerCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.terrains import TerrainEntityCfg
from mjlab.utils.indexing import as_columns
from mjlab.viewer import ViewerConfig

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

_CARTPOLE_XML = Path(__file__).parent / "cartpole.xml"


def cartpole_balance_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the balance task: the pole starts upright."""
    return ManagerBasedRlEnvCfg(
        scene=SceneCfg(
            terrain=TerrainEntityCfg(terrain_type="plane"),
            entities={"cartpole": copy.deepcopy(_CARTPOLE)},
            num_envs=1,
            env_spacing=4.0,
        ),
        observations={
            "actor": ObservationGroupCfg(copy.deepcopy(_OBSERVATIONS), enable_corruption=not play),
            "critic": ObservationGroupCfg(copy.deepcopy(_OBSERVATIONS)),
        },
        actions={
            "effort": JointEffortActionCfg(
                entity_name="cartpole", actuator_names=("slider",), scale=1.0
            ),
        },
        events={
            "reset_slider": _reset("slider", (-0.1, 0.1)),
            "reset_hinge": _reset("hinge_1", (-0.034, 0.034)),
        },
        rewards={
            "smooth_reward": RewardTermCfg(
                func=cartpole_smooth_reward,
                weight=1.0,
                params={"cart_cfg": _joint("slider"), "hinge_cfg": _joint("hinge_1")},
            ),
        },
        terminations={"time_out": TerminationTermCfg(func=time_out, time_out=True)},
        sim=SimulationCfg(mujoco=MujocoCfg(timestep=0.01, disableflags=("contact",))),
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="cartpole",
            body_name="cart",
            distance=4.0,
            elevation=-15.0,
            azimuth=0.0,
            camera="cartpole/side",
        ),
        decimation=5,
        # Play mode: effectively infinite episodes.
        episode_length_s=1e10 if play else 50.0,
    )


def cartpole_swingup_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the swing-up task: the pole starts hanging down."""
    cfg = cartpole_balance_env_cfg(play)
    cfg.scene.entities["cartpole"].init_state.joint_pos = {"slider": 0.0, "hinge_1": math.pi}
    return cfg


def cartpole_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO config of both tasks."""
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(64, 64),
            distribution_cfg={
                "class_name": "GaussianDistribution",
                "init_std": 1.0,
                "std_type": "scalar",
            },
        ),
        critic=RslRlModelCfg(hidden_dims=(64, 64)),
        algorithm=RslRlPpoAlgorithmCfg(entropy_coef=0.01),
        experiment_name="cartpole",
        num_steps_per_env=32,
        max_iterations=500,
        evaluation=EvaluationCfg(solved_return=900.0),
    )


def _evaluate_quickly(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg) -> None:
    # Episodes of one policy hardly differ: the standard deviation of returns is below 1.
    rl_cfg.evaluation.num_episodes = 64


cpu = cpu_profile(
    _evaluate_quickly,
    num_envs=256,
    num_steps_per_env=12,
    hidden_dims=(64, 64),
    max_iterations=500,
)
"""The `cpu` profile of both tasks. `docs/guides/experiments.md` has the experiments."""


# Task-specific MDP terms.


def _joint(name: str) -> SceneEntityCfg:
    return SceneEntityCfg("cartpole", joint_names=(name,))


_CART, _HINGE = _joint("slider"), _joint("hinge_1")


def pole_angle_cos_sin(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _HINGE) -> torch.Tensor:
    """Return cosine and sine of the hinge angle, (N, 2).

    The angle itself is unbounded, because the hinge has no limits.
    """
    asset: Entity = env.scene[asset_cfg.name]
    angle = asset.data.joint_pos[:, as_columns(asset_cfg.joint_ids, env.device)]
    return torch.cat([torch.cos(angle), torch.sin(angle)], dim=-1)


def cartpole_smooth_reward(
    env: ManagerBasedRlEnv,
    cart_cfg: SceneEntityCfg = _CART,
    hinge_cfg: SceneEntityCfg = _HINGE,
) -> torch.Tensor:
    """Return the control suite's smooth cartpole reward, (N,) in [0, 1].

    With pole angle θ and velocity θ̇, cart position x, control u and Gaussian tolerance g:

        r = (cos θ + 1) / 2 * (1 + g(x)) / 2 * (4 + max(0, 1 - u^2)) / 5 * (1 + g(θ̇)) / 2

    g is 0.1 at 2 m and at 5 rad/s. The product is high only if the pole is upright, the cart centered,
    the control small and the pole slow, all at the same time.
    """
    data = env.scene[cart_cfg.name].data
    slider = as_columns(cart_cfg.joint_ids, env.device)
    hinge = as_columns(hinge_cfg.joint_ids, env.device)
    x = data.joint_pos[:, slider].squeeze(-1)
    u = data.joint_effort_target[:, slider].squeeze(-1)
    theta = data.joint_pos[:, hinge].squeeze(-1)
    theta_dot = data.joint_vel[:, hinge].squeeze(-1)

    upright = (torch.cos(theta) + 1.0) / 2.0
    centered = (1.0 + _gaussian_tolerance(x, margin=2.0)) / 2.0
    small_control = (4.0 + (1.0 - u.square()).clamp(min=0.0)) / 5.0
    small_velocity = (1.0 + _gaussian_tolerance(theta_dot, margin=5.0)) / 2.0
    return upright * centered * small_control * small_velocity


def _gaussian_tolerance(value: torch.Tensor, margin: float) -> torch.Tensor:
    """Return a Gaussian of `value`: 1 at 0, and 0.1 at |value| = margin."""
    return torch.exp(math.log(0.1) * torch.square(value / margin))


# Environment config. The tasks copy the entity and the observations.


def _get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(_CARTPOLE_XML))


def _reset(joint: str, position_range: tuple[float, float]) -> EventTermCfg:
    return EventTermCfg(
        func=reset_joints_by_offset,
        mode="reset",
        params={
            "position_range": position_range,
            "velocity_range": (-0.01, 0.01),
            "asset_cfg": _joint(joint),
        },
    )


_CARTPOLE = EntityCfg(
    spec_fn=_get_spec,
    # Motor from the XML, unchanged.
    articulation=EntityArticulationInfoCfg(
        actuators=(XmlActuatorCfg(target_names_expr=("slider",)),)
    ),
    # Joint angle 0: upright.
    init_state=EntityCfg.InitialStateCfg(
        joint_pos={"slider": 0.0, "hinge_1": 0.0}, joint_vel={".*": 0.0}
    ),
)

_OBSERVATIONS: dict[str, ObservationTermCfg] = {
    "cart_pos": ObservationTermCfg(func=joint_pos_rel, params={"asset_cfg": _joint("slider")}),
    "pole_angle": ObservationTermCfg(
        func=pole_angle_cos_sin, params={"asset_cfg": _joint("hinge_1")}
    ),
    "cart_vel": ObservationTermCfg(func=joint_vel_rel, params={"asset_cfg": _joint("slider")}),
    "pole_vel": ObservationTermCfg(func=joint_vel_rel, params={"asset_cfg": _joint("hinge_1")}),
}
