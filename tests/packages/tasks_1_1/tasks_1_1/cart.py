"""A cart that balances a pole at a goal position."""

from __future__ import annotations

from pathlib import Path

import mujoco
import torch

from mjlab.actuator import XmlMotorActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointEffortActionCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.terrains import TerrainImporterCfg
from mjlab.utils.os import update_assets
from mjlab.utils.spec import disable_collision
from mjlab.utils.spec_config import MaterialCfg, TextureCfg

from .commands import ClockCommandCfg, GoalCommandCfg

_HERE = Path(__file__).parent


def get_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(_HERE / "cart.xml"))
    assets: dict[str, bytes] = {}
    update_assets(assets, _HERE / "assets", spec.meshdir)
    spec.assets = assets
    disable_collision(spec.geom("pole"))
    return spec


_CART = EntityCfg(
    spec_fn=get_spec,
    init_state=EntityCfg.InitialStateCfg(joint_pos={".*": 0.0}, joint_vel={".*": 0.0}),
    articulation=EntityArticulationInfoCfg(
        actuators=(XmlMotorActuatorCfg(target_names_expr=("slider",)),)
    ),
    textures=(
        TextureCfg(
            name="stripes",
            type="2d",
            builtin="checker",
            rgb1=(0.1, 0.2, 0.3),
            rgb2=(0.9, 0.9, 0.9),
            width=32,
            height=32,
        ),
    ),
    materials=(MaterialCfg(name="stripes", texture="stripes", texuniform=True, texrepeat=(4, 4)),),
)


def _term(joint: str) -> dict:
    return {"asset_cfg": SceneEntityCfg("cart", joint_names=(joint,))}


def goal_error(env, command_name: str, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    position = env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids].squeeze(-1)
    goal = env.command_manager.get_command(command_name)[:, 0]
    return torch.exp(-torch.square(position - goal))


def upright(env, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    return env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids].squeeze(-1).cos()


def cart_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    actor_terms = {
        "slider": ObservationTermCfg(func=mdp.joint_pos_rel, params=_term("slider")),
        "hinge": ObservationTermCfg(func=mdp.joint_pos_rel, params=_term("hinge")),
        "velocity": ObservationTermCfg(func=mdp.joint_vel_rel, params=_term(".*")),
        "goal": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "goal"}),
        "clock": ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "clock"}),
    }
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=5.0,
        scene=SceneCfg(
            terrain=TerrainImporterCfg(terrain_type="plane"), entities={"cart": _CART}, num_envs=1
        ),
        observations={
            "actor": ObservationGroupCfg(actor_terms, enable_corruption=not play),
            "critic": ObservationGroupCfg({**actor_terms}),
        },
        actions={"push": JointEffortActionCfg(entity_name="cart", actuator_names=("slider",))},
        commands={
            "goal": GoalCommandCfg(resampling_time_range=(1.0, 2.0), goal_range=(-0.5, 0.5)),
            "clock": ClockCommandCfg(resampling_time_range=(10.0, 10.0)),
        },
        events={
            "reset": EventTermCfg(
                func=mdp.reset_joints_by_offset,
                mode="reset",
                params={
                    "position_range": (-0.1, 0.1),
                    "velocity_range": (-0.1, 0.1),
                    **_term(".*"),
                },
            ),
            "damping": EventTermCfg(
                func=mdp.randomize_field,
                mode="startup",
                domain_randomization=True,
                params={
                    "field": "dof_damping",
                    "ranges": (0.8, 1.2),
                    "operation": "scale",
                    **_term("hinge"),
                },
            ),
        },
        rewards={
            "goal": RewardTermCfg(
                func=goal_error, weight=1.0, params={"command_name": "goal", **_term("slider")}
            ),
            "upright": RewardTermCfg(func=upright, weight=1.0, params=_term("hinge")),
        },
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
        sim=SimulationCfg(
            nconmax=10, njmax=50, ls_parallel=True, mujoco=MujocoCfg(timestep=0.005, multiccd=True)
        ),
    )


def cart_rl_cfg() -> RslRlOnPolicyRunnerCfg:
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(16,), stochastic=True, init_noise_std=0.8, noise_std_type="log"
        ),
        critic=RslRlModelCfg(hidden_dims=(16,), stochastic=False),
        algorithm=RslRlPpoAlgorithmCfg(num_mini_batches=1),
        experiment_name="tasks_1_1_cart",
    )
