"""Base config of motion tracking: imitate reference motions.

Robot packages call `make_tracking_env_cfg()` and fill in the robot-specific fields. See
`config/g1`.
"""

from __future__ import annotations

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
from mjlab.tasks.tracking import mdp
from mjlab.terrains import TerrainEntityCfg
from mjlab.utils.noise import UniformNoiseCfg
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

    Building the environment raises for fields left empty.
    """
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=10.0,
        scene=SceneCfg(terrain=TerrainEntityCfg(terrain_type="plane"), num_envs=1),
        observations=_observations(),
        actions={
            "joint_pos": mdp.JointPositionActionCfg(
                entity_name="robot", actuator_names=(".*",), scale=0.5, use_default_offset=True
            )
        },
        commands=_commands(),
        events=_events(),
        rewards=_rewards(),
        terminations=_terminations(),
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


def _noise(size: float) -> UniformNoiseCfg:
    return UniformNoiseCfg(n_min=-size, n_max=size)


def _of_motion(func: object, noise: float | None = None) -> ObservationTermCfg:
    return ObservationTermCfg(
        func=func,
        params={"command_name": "motion"},
        noise=None if noise is None else _noise(noise),
    )


def _of_imu(sensor: str, noise: float | None = None) -> ObservationTermCfg:
    return ObservationTermCfg(
        func=mdp.builtin_sensor,
        params={"sensor_name": f"robot/{sensor}"},
        noise=None if noise is None else _noise(noise),
    )


def _observations() -> dict[str, ObservationGroupCfg | None]:
    actor: dict[str, ObservationTermCfg | None] = {
        "command": _of_motion(mdp.generated_commands),
        "motion_anchor_pos_b": _of_motion(mdp.motion_anchor_pos_b, noise=0.25),
        "motion_anchor_ori_b": _of_motion(mdp.motion_anchor_ori_b, noise=0.05),
        "base_lin_vel": _of_imu("imu_lin_vel", noise=0.5),
        "base_ang_vel": _of_imu("imu_ang_vel", noise=0.2),
        "joint_pos": ObservationTermCfg(
            func=mdp.joint_pos_rel, params={"biased": True}, noise=_noise(0.01)
        ),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel, noise=_noise(0.5)),
        "actions": ObservationTermCfg(func=mdp.last_action),
    }
    # Critic: privileged terms, without noise and encoder bias.
    critic: dict[str, ObservationTermCfg | None] = {
        "command": _of_motion(mdp.generated_commands),
        "motion_anchor_pos_b": _of_motion(mdp.motion_anchor_pos_b),
        "motion_anchor_ori_b": _of_motion(mdp.motion_anchor_ori_b),
        "body_pos": _of_motion(mdp.robot_body_pos_b),
        "body_ori": _of_motion(mdp.robot_body_ori_b),
        "base_lin_vel": _of_imu("imu_lin_vel"),
        "base_ang_vel": _of_imu("imu_ang_vel"),
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel),
        "actions": ObservationTermCfg(func=mdp.last_action),
    }
    return {
        "actor": ObservationGroupCfg(terms=actor, enable_corruption=True),
        "critic": ObservationGroupCfg(terms=critic),
    }


def _commands() -> dict[str, CommandTermCfg | None]:
    return {
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


def _events() -> dict[str, EventTermCfg | None]:
    return {
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


def _rewards() -> dict[str, RewardTermCfg | None]:
    def term(func: object, weight: float, std: float) -> RewardTermCfg:
        return RewardTermCfg(
            func=func, weight=weight, params={"command_name": "motion", "std": std}
        )

    return {
        "motion_global_root_pos": term(mdp.motion_global_anchor_position_error_exp, 0.5, 0.3),
        "motion_global_root_ori": term(mdp.motion_global_anchor_orientation_error_exp, 0.5, 0.4),
        "motion_body_pos": term(mdp.motion_relative_body_position_error_exp, 1.0, 0.3),
        "motion_body_ori": term(mdp.motion_relative_body_orientation_error_exp, 1.0, 0.4),
        "motion_body_lin_vel": term(mdp.motion_global_body_linear_velocity_error_exp, 1.0, 1.0),
        "motion_body_ang_vel": term(mdp.motion_global_body_angular_velocity_error_exp, 1.0, 3.14),
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


def _terminations() -> dict[str, TerminationTermCfg | None]:
    return {
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
