"""Unitree G1 motion tracking tasks."""

from __future__ import annotations

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_ACTION_SCALE
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg
from mjlab.tasks.tracking import mdp
from mjlab.tasks.tracking.tracking_env_cfg import make_tracking_env_cfg

MOTIONS = "squat,wave"
"""Default motions, bundled with the package."""

_TORSO = "torso_link"
_BODIES = (
    "pelvis",
    "left_hip_roll_link",
    "left_knee_link",
    "left_ankle_roll_link",
    "right_hip_roll_link",
    "right_knee_link",
    "right_ankle_roll_link",
    _TORSO,
    "left_shoulder_roll_link",
    "left_elbow_link",
    "left_wrist_yaw_link",
    "right_shoulder_roll_link",
    "right_elbow_link",
    "right_wrist_yaw_link",
)
_END_EFFECTORS = (
    "left_ankle_roll_link",
    "right_ankle_roll_link",
    "left_wrist_yaw_link",
    "right_wrist_yaw_link",
)
_FOOT_GEOMS = r"^(left|right)_foot[1-7]_collision$"


def unitree_g1_flat_tracking_env_cfg(
    has_state_estimation: bool = True, play: bool = False, evaluate: bool = False
) -> ManagerBasedRlEnvCfg:
    """Return the config of the task, for training, to `play`, or to `evaluate`.

    Args:
        has_state_estimation: Let the policy observe its base velocity and the position of the
            reference anchor, which a real robot must estimate.
        play: Start at the first frame without perturbation; no noise, no pushes.
        evaluate: Play each motion once, from start to end, without pushes.
    """
    cfg = make_tracking_env_cfg()
    action, motion = cfg.actions["joint_pos"], cfg.commands["motion"]
    assert isinstance(action, mdp.JointPositionActionCfg)
    assert isinstance(motion, mdp.MotionCommandCfg)
    cfg.scene.entities = {"robot": get_g1_robot_cfg()}
    itself = ContactMatch(mode="subtree", pattern="pelvis", entity="robot")
    cfg.scene.sensors += (
        ContactSensorCfg(
            name="self_collision",
            primary=itself,
            secondary=itself,
            fields=("found", "force"),
            reduce="maxforce",
            num_slots=1,
            history_length=4,
        ),
    )
    action.scale = dict(G1_ACTION_SCALE)
    motion.motion_file = MOTIONS
    motion.anchor_body_name = _TORSO
    motion.body_names = _BODIES
    cfg.events["foot_friction"].params["asset_cfg"].geom_names = _FOOT_GEOMS
    cfg.events["base_com"].params["asset_cfg"].body_names = (_TORSO,)
    cfg.terminations["ee_body_pos"].params["body_names"] = _END_EFFECTORS
    cfg.viewer.body_name = _TORSO
    actor = cfg.observations["actor"]
    if not has_state_estimation:
        actor.terms.pop("motion_anchor_pos_b")
        actor.terms.pop("base_lin_vel")
    if play:
        cfg.episode_length_s = int(1e9)
        actor.enable_corruption = False
        cfg.events.pop("push_robot")
        motion.pose_range = {}
        motion.velocity_range = {}
        motion.joint_position_range = (0.0, 0.0)
        motion.sampling_mode = "start"
    elif evaluate:
        mdp.metrics.play_motions_once(cfg)
    return cfg


def unitree_g1_flat_tracking_no_state_estimation_env_cfg(
    play: bool = False, evaluate: bool = False
) -> ManagerBasedRlEnvCfg:
    """Return the config of the task without observations of base velocity and anchor position."""
    return unitree_g1_flat_tracking_env_cfg(False, play, evaluate)
