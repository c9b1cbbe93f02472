"""A crawler on four legs, from the velocity template: feet are sites, their height is above 0."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg, DelayedActuatorCfg
from mjlab.asset_zoo.robots import GO1_ACTION_SCALE
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs.mdp import sync_actuator_delays
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.tasks.velocity.rl import VelocityOnPolicyRunner
from mjlab.tasks.velocity.velocity_env_cfg import make_velocity_env_cfg
from mjlab.utils.spec_config import CollisionCfg

_FEET = ("FL", "FR", "RL", "RR")
_FOOT_GEOMS = tuple(f"{foot}_foot_collision" for foot in _FEET)

_LEGS = DelayedActuatorCfg(
    base_cfg=BuiltinPositionActuatorCfg(
        target_names_expr=(".*_hip",), stiffness=20.0, damping=0.5, effort_limit=15.0, armature=0.01
    ),
    delay_target="position",
    delay_min_lag=0,
    delay_max_lag=2,
)
# Action scales are read off the actuator that the delay wraps.
assert isinstance(_LEGS, DelayedActuatorCfg)
_ACTION_SCALE = 0.25 * _LEGS.base_cfg.effort_limit / _LEGS.base_cfg.stiffness
assert set(GO1_ACTION_SCALE) == {".*_hip_joint", ".*_thigh_joint", ".*_calf_joint"}


@dataclass(kw_only=True)
class FeetContactCfg(ContactSensorCfg):
    """Contacts of feet with the ground, whose fields say nothing of the air time that it tracks."""

    fields: tuple[str, ...] = ("force",)
    reduce: str = "netforce"
    track_air_time: bool = True


def time_in_air(env, sensor_name: str) -> torch.Tensor:
    data = env.scene[sensor_name].data
    assert data.current_air_time.shape == (env.num_envs, len(_FEET))
    # A foot is in the air or on the ground.
    assert (data.current_air_time + data.current_contact_time >= 0.0).all()
    return data.current_air_time.mean(dim=1)


def get_spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(Path(__file__).parent / "crawler.xml"))


def get_crawler_cfg() -> EntityCfg:
    return EntityCfg(
        spec_fn=get_spec,
        init_state=EntityCfg.InitialStateCfg(
            pos=(0.0, 0.0, 0.31), joint_pos={".*": 0.0}, joint_vel={".*": 0.0}
        ),
        # Legs that no pattern of condim and priority names keep 3 and 0.
        collisions=(
            CollisionCfg(
                geom_names_expr=(".*_collision",),
                condim={".*_foot_collision": 6},
                priority={".*_foot_collision": 1},
                friction={".*_foot_collision": (0.8, 5e-3, 5e-4)},
            ),
        ),
        articulation=EntityArticulationInfoCfg(actuators=(_LEGS,), soft_joint_pos_limit_factor=0.9),
    )


def crawler_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    cfg = make_velocity_env_cfg()
    cfg.scene.entities = {"robot": get_crawler_cfg()}
    feet_ground = ContactSensorCfg(
        name="feet_ground_contact",
        primary=ContactMatch(mode="geom", pattern=_FOOT_GEOMS, entity="robot"),
        secondary=ContactMatch(mode="body", pattern="terrain"),
        fields=("found", "force"),
        reduce="netforce",
        num_slots=1,
        track_air_time=True,
    )
    feet_air = FeetContactCfg(
        name="feet_air",
        primary=ContactMatch(mode="geom", pattern=_FOOT_GEOMS, entity="robot"),
        secondary=ContactMatch(mode="body", pattern="terrain"),
    )
    # The template of this release brings one sensor, the scan of the terrain.
    kept = tuple(sensor for sensor in cfg.scene.sensors if sensor.name != "terrain_scan")
    cfg.scene.sensors = (*kept, feet_ground, feet_air)
    cfg.scene.terrain.terrain_type = "plane"
    cfg.scene.terrain.terrain_generator = None
    for group in cfg.observations.values():
        del group.terms["height_scan"]
    del cfg.curriculum["terrain_levels"]

    action = cfg.actions["joint_pos"]
    assert isinstance(action, JointPositionActionCfg)
    action.scale = _ACTION_SCALE
    cfg.viewer.body_name = "trunk"
    cfg.commands["twist"].viz.z_offset = 0.5

    cfg.observations["critic"].terms["foot_height"].params["asset_cfg"].site_names = _FEET
    cfg.events["foot_friction"].params["asset_cfg"].geom_names = _FOOT_GEOMS
    cfg.events["base_com"].params["asset_cfg"].body_names = ("trunk",)
    cfg.events["delays"] = EventTermCfg(
        func=sync_actuator_delays,
        mode="reset",
        params={"lag_range": (0, 2), "asset_cfg": SceneEntityCfg("robot")},
    )
    cfg.rewards["pose"].params["std_standing"] = {".*": 0.05}
    cfg.rewards["pose"].params["std_walking"] = {".*": 0.3}
    cfg.rewards["pose"].params["std_running"] = {".*": 0.3}
    cfg.rewards["upright"].params["asset_cfg"].body_names = ("trunk",)
    cfg.rewards["body_ang_vel"].params["asset_cfg"].body_names = ("trunk",)
    for reward in ("foot_clearance", "foot_swing_height", "foot_slip"):
        cfg.rewards[reward].params["asset_cfg"].site_names = _FEET
    cfg.rewards["air_time"].weight = 0.5
    cfg.rewards["time_in_air"] = RewardTermCfg(
        func=time_in_air, weight=0.1, params={"sensor_name": "feet_air"}
    )

    if play:
        cfg.episode_length_s = int(1e9)
        cfg.observations["actor"].enable_corruption = False
        cfg.events.pop("push_robot", None)
    return cfg


def crawler_rl_cfg() -> RslRlOnPolicyRunnerCfg:
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(hidden_dims=(32, 32), obs_normalization=True, stochastic=True),
        critic=RslRlModelCfg(hidden_dims=(32, 32), obs_normalization=True, stochastic=False),
        algorithm=RslRlPpoAlgorithmCfg(num_mini_batches=1, num_learning_epochs=2),
        experiment_name="tasks_1_1_crawler",
        max_iterations=1000,
    )


class CrawlerRunner(VelocityOnPolicyRunner):
    """Runner that uploads the policy only if the run is logged by Weights & Biases."""

    uploads: int = 0

    def save(self, path: str, infos=None):
        super().save(path, infos)
        if self.logger.logger_type in ("wandb",):
            self.uploads += 1
