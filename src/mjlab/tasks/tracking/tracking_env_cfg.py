"""Base config of motion tracking: imitate reference motions.

Robot packages call `make_tracking_env_cfg()` and fill in the robot-specific fields. See
`config/g1`.
"""

from __future__ import annotations

import copy

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import (
    CommandTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.terms import observation
from mjlab.tasks.tracking import mdp
from mjlab.terrains import TerrainEntityCfg
from mjlab.viewer import ViewerConfig

# Placeholder for robot-specific names.
_NO_NAMES: tuple[str, ...] = ()

VELOCITY_RANGE = {
    "x": (-0.5, 0.5),
    "y": (-0.5, 0.5),
    "z": (-0.2, 0.2),
    "roll": (-0.52, 0.52),
    "pitch": (-0.52, 0.52),
    "yaw": (-0.78, 0.78),
}
"""Perturbation of the root velocity by pushes and at episode starts (m/s, rad/s)."""


def make_tracking_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return a new config of the task, without robot and motion.

    The config shares no objects with other configs and may be edited freely. Fill in:

    - `scene.entities["robot"]`, and a contact sensor `self_collision` for the reward
      `self_collisions`;
    - the motion, the anchor and the tracked bodies of the command `motion`;
    - the action's scale; the geoms of `foot_friction`, the bodies of `base_com` and of the
      termination `ee_body_pos`;
    - `viewer.body_name`.

    Building the environment raises for fields of the command and of sensors left empty, and warns of
    terms.
    """
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=10.0,
        scene=SceneCfg(terrain=TerrainEntityCfg(terrain_type="plane"), num_envs=1),
        observations={
            "actor": ObservationGroupCfg(terms=_ACTOR_TERMS, enable_corruption=True),
            "critic": ObservationGroupCfg(terms=_CRITIC_TERMS),
        },
        actions={
            "joint_pos": mdp.JointPositionActionCfg(
                entity_name="robot", actuator_names=(".*",), scale=0.5, use_default_offset=True
            )
        },
        commands=_COMMANDS,
        events=_EVENTS,
        rewards=_REWARDS,
        terminations=_TERMINATIONS,
        sim=SimulationCfg(
            nconmax=35,
            njmax=250,
            mujoco=MujocoCfg(timestep=0.005, iterations=10, ls_iterations=20),
        ),
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name="",
            distance=2.8,
            fovy=55.0,
            elevation=-5.0,
            azimuth=120.0,
        ),
    )
    # The sections are module constants.
    return copy.deepcopy(cfg)


# Config sections. `make_tracking_env_cfg` copies them.


_ACTOR_TERMS: dict[str, ObservationTermCfg] = {
    "command": observation(mdp.generated_commands, command_name="motion"),
    "motion_anchor_pos_b": observation(mdp.motion_anchor_pos_b, 0.25, command_name="motion"),
    "motion_anchor_ori_b": observation(mdp.motion_anchor_ori_b, 0.05, command_name="motion"),
    "base_lin_vel": observation(mdp.builtin_sensor, 0.5, sensor_name="robot/imu_lin_vel"),
    "base_ang_vel": observation(mdp.builtin_sensor, 0.2, sensor_name="robot/imu_ang_vel"),
    "joint_pos": observation(mdp.joint_pos_rel, 0.01, biased=True),
    "joint_vel": observation(mdp.joint_vel_rel, 0.5),
    "actions": observation(mdp.last_action),
}
# Privileged terms, without noise and encoder bias.
_CRITIC_TERMS: dict[str, ObservationTermCfg] = {
    "command": observation(mdp.generated_commands, command_name="motion"),
    "motion_anchor_pos_b": observation(mdp.motion_anchor_pos_b, command_name="motion"),
    "motion_anchor_ori_b": observation(mdp.motion_anchor_ori_b, command_name="motion"),
    "body_pos": observation(mdp.robot_body_pos_b, command_name="motion"),
    "body_ori": observation(mdp.robot_body_ori_b, command_name="motion"),
    "base_lin_vel": observation(mdp.builtin_sensor, sensor_name="robot/imu_lin_vel"),
    "base_ang_vel": observation(mdp.builtin_sensor, sensor_name="robot/imu_ang_vel"),
    "joint_pos": observation(mdp.joint_pos_rel),
    "joint_vel": observation(mdp.joint_vel_rel),
    "actions": observation(mdp.last_action),
}

_COMMANDS: dict[str, CommandTermCfg] = {
    "motion": mdp.MotionCommandCfg(
        entity_name="robot",
        resampling_time_range=(1.0e9, 1.0e9),
        debug_vis=True,
        motion_file="",
        anchor_body_name="",
        body_names=_NO_NAMES,
        pose_range={
            "x": (-0.05, 0.05),
            "y": (-0.05, 0.05),
            "z": (-0.01, 0.01),
            "roll": (-0.1, 0.1),
            "pitch": (-0.1, 0.1),
            "yaw": (-0.2, 0.2),
        },
        velocity_range=dict(VELOCITY_RANGE),
        joint_position_range=(-0.1, 0.1),
    )
}

_EVENTS: dict[str, EventTermCfg] = {
    "push_robot": EventTermCfg(
        func=mdp.push_by_setting_velocity,
        mode="interval",
        interval_range_s=(1.0, 3.0),
        params={"velocity_range": dict(VELOCITY_RANGE)},
    ),
    "base_com": EventTermCfg(
        func=mdp.dr.body_com_offset,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names=_NO_NAMES),
            "operation": "add",
            "ranges": {0: (-0.025, 0.025), 1: (-0.05, 0.05), 2: (-0.05, 0.05)},
        },
    ),
    "encoder_bias": EventTermCfg(
        func=mdp.dr.encoder_bias,
        mode="startup",
        params={"asset_cfg": SceneEntityCfg("robot"), "bias_range": (-0.01, 0.01)},
    ),
    "foot_friction": EventTermCfg(
        func=mdp.dr.geom_friction,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", geom_names=_NO_NAMES),
            "operation": "abs",
            "ranges": (0.3, 1.2),
            # Same friction for all feet of an environment.
            "shared_random": True,
        },
    ),
}


def _tracking(func: object, weight: float, std: float) -> RewardTermCfg:
    return RewardTermCfg(func=func, weight=weight, params={"command_name": "motion", "std": std})


_REWARDS: dict[str, RewardTermCfg] = {
    "motion_global_root_pos": _tracking(mdp.motion_global_anchor_position_error_exp, 0.5, 0.3),
    "motion_global_root_ori": _tracking(mdp.motion_global_anchor_orientation_error_exp, 0.5, 0.4),
    "motion_body_pos": _tracking(mdp.motion_relative_body_position_error_exp, 1.0, 0.3),
    "motion_body_ori": _tracking(mdp.motion_relative_body_orientation_error_exp, 1.0, 0.4),
    "motion_body_lin_vel": _tracking(mdp.motion_global_body_linear_velocity_error_exp, 1.0, 1.0),
    "motion_body_ang_vel": _tracking(mdp.motion_global_body_angular_velocity_error_exp, 1.0, 3.14),
    "action_rate_l2": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.1),
    "joint_limit": RewardTermCfg(
        func=mdp.joint_pos_limits,
        weight=-10.0,
        params={"asset_cfg": SceneEntityCfg("robot", joint_names=(".*",))},
    ),
    "self_collisions": RewardTermCfg(
        func=mdp.self_collision_cost,
        weight=-10.0,
        params={"sensor_name": "self_collision", "force_threshold": 10.0},
    ),
}

_TERMINATIONS: dict[str, TerminationTermCfg] = {
    "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
    "anchor_pos": TerminationTermCfg(
        func=mdp.bad_anchor_pos_z_only, params={"command_name": "motion", "threshold": 0.25}
    ),
    "anchor_ori": TerminationTermCfg(
        func=mdp.bad_anchor_ori,
        params={
            "asset_cfg": SceneEntityCfg("robot"),
            "command_name": "motion",
            "threshold": 0.8,
        },
    ),
    "ee_body_pos": TerminationTermCfg(
        func=mdp.bad_motion_body_pos_z_only,
        params={"command_name": "motion", "threshold": 0.25, "body_names": _NO_NAMES},
    ),
    # The end of the motion truncates the episode; it is not a failure.
    "motion_ended": TerminationTermCfg(
        func=mdp.motion_ended, time_out=True, params={"command_name": "motion"}
    ),
}
