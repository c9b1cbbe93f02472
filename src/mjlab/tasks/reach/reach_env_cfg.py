"""Base config of the reach task: move the hand of an arm to goal poses, one after the other.

Robot packages call `make_reach_env_cfg()` and fill in the robot-specific fields. See `yam_env_cfg`.
"""

from __future__ import annotations

import copy

from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.managers import (
    CommandTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.terms import observation
from mjlab.terrains import TerrainEntityCfg
from mjlab.viewer import ViewerConfig

GOAL_TIME = 4.0
"""Time for each goal (s)."""
_COMMAND = "hand_pose"
_ALL_JOINTS = SceneEntityCfg("robot", joint_names=(".*",))


def make_reach_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return a new config of the task, without a robot.

    The config shares no objects with other configs and may be edited freely. Fill in:

    - `scene.entities["robot"]`;
    - the frame of the command `hand_pose`, a body, site or geom of the robot;
    - the joints of the action `joint_pos`, without those of a gripper, and the action's scale;
    - `viewer.body_name`.
    """
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=3 * GOAL_TIME,
        scene=SceneCfg(terrain=TerrainEntityCfg(terrain_type="plane"), num_envs=1, env_spacing=2.0),
        # Critic: same terms without noise, since its group has no corruption.
        observations={
            "actor": ObservationGroupCfg(terms=_TERMS, enable_corruption=True),
            "critic": ObservationGroupCfg(terms=copy.deepcopy(_TERMS)),
        },
        actions={
            "joint_pos": mdp.JointPositionActionCfg(
                entity_name="robot", actuator_names=(".*",), scale=0.5, use_default_offset=True
            )
        },
        commands=_COMMANDS,
        events=_EVENTS,
        rewards=_REWARDS,
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
        sim=SimulationCfg(
            nconmax=35,
            njmax=300,
            mujoco=MujocoCfg(timestep=0.005, iterations=10, ls_iterations=20),
        ),
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name="",
            distance=1.8,
            elevation=-15.0,
            azimuth=130.0,
        ),
    )
    # The sections are module constants.
    return copy.deepcopy(cfg)


# Config sections. `make_reach_env_cfg` copies them.

_TERMS = {
    "joint_pos": observation(mdp.joint_pos_rel, 0.01),
    "joint_vel": observation(mdp.joint_vel_rel, 0.1),
    "goal": observation(mdp.generated_commands, command_name=_COMMAND),
    "goal_error": observation(mdp.pose_command_error, command_name=_COMMAND),
    "actions": observation(mdp.last_action),
}

_COMMANDS: dict[str, CommandTermCfg] = {
    _COMMAND: mdp.UniformPoseCommandCfg(
        entity_name="robot",
        frame_type="site",
        frame_name="",
        resampling_time_range=(GOAL_TIME, GOAL_TIME),
        debug_vis=True,
    )
}

_EVENTS: dict[str, EventTermCfg] = {
    "reset_base": EventTermCfg(
        func=mdp.reset_root_state_uniform, mode="reset", params={"pose_range": {}}
    ),
    "reset_robot_joints": EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={
            "position_range": (-0.3, 0.3),
            "velocity_range": (0.0, 0.0),
            "asset_cfg": _ALL_JOINTS,
        },
    ),
}

# The wide rewards lead to the goal, the narrow ones to within centimeters and a tenth of a radian. Without
# that of the joints, policies stop at joint limits: 82 instead of 88 % of the YAM's goals, with PPO.
_REWARDS: dict[str, RewardTermCfg] = {
    "position": RewardTermCfg(
        func=mdp.position_command_error, weight=-4.0, params={"command_name": _COMMAND}
    ),
    "position_narrow": RewardTermCfg(
        func=mdp.position_command_error_tanh,
        weight=2.0,
        params={"command_name": _COMMAND, "std": 0.1},
    ),
    "orientation": RewardTermCfg(
        func=mdp.orientation_command_error, weight=-0.6, params={"command_name": _COMMAND}
    ),
    "orientation_narrow": RewardTermCfg(
        func=mdp.orientation_command_error_tanh,
        weight=1.0,
        params={"command_name": _COMMAND, "std": 0.3},
    ),
    "joints": RewardTermCfg(
        func=mdp.goal_joint_deviation_l1, weight=-0.3, params={"command_name": _COMMAND}
    ),
    "action_rate_l2": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.005),
    "joint_vel_l2": RewardTermCfg(
        func=mdp.joint_vel_l2, weight=-0.002, params={"asset_cfg": _ALL_JOINTS}
    ),
    "joint_pos_limits": RewardTermCfg(
        func=mdp.joint_pos_limits, weight=-1.0, params={"asset_cfg": _ALL_JOINTS}
    ),
}
