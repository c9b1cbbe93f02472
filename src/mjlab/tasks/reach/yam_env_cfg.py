"""Reach task of the YAM arm."""

from __future__ import annotations

from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.tasks.reach.reach_env_cfg import make_reach_env_cfg

_ARM = ("joint[1-6]",)
# Joint target (rad) per unit action. All joints reach the goals' joint positions with actions of at most
# 1.7; with 0.7, the first quarter of a million steps teaches a third as much.
_ACTION_SCALE = 1.5


def yam_reach_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the config of the task, for training or `play`."""
    cfg = make_reach_env_cfg()
    robot = get_yam_robot_cfg()
    # The gripper touches the ground, but not itself: it keeps still, and such contacts take half of the
    # time of the physics.
    for collision in robot.collisions:
        collision.conaffinity = 0
    cfg.scene.entities = {"robot": robot}
    action, command = cfg.actions["joint_pos"], cfg.commands["hand_pose"]
    assert isinstance(action, mdp.JointPositionActionCfg)
    assert isinstance(command, mdp.UniformPoseCommandCfg)
    # The gripper keeps still.
    action.actuator_names, action.scale = _ARM, _ACTION_SCALE
    command.frame_name = "grasp_site"
    # The fingers move a little by themselves.
    for term in (cfg.rewards["joint_vel_l2"], cfg.events["reset_robot_joints"]):
        term.params["asset_cfg"].joint_names = _ARM
    cfg.viewer.body_name = "arm"
    if play:
        cfg.episode_length_s = int(1e9)
        cfg.observations["actor"].enable_corruption = False
    return cfg
