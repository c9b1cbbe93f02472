"""Environment configs of the velocity tasks of the Unitree G1."""

from __future__ import annotations

import copy

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_ACTION_SCALE
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import RewardTermCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg, RingPatternCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.velocity_env_cfg import (
    make_flat,
    make_legged_env_cfg,
    make_playable,
    remove_state_estimation,
)

# Model order, the order of contacts and sites.
_FEET = ("left_foot", "right_foot")
_FOOT_GEOMS = tuple(f"{foot}{i}_collision" for foot in _FEET for i in range(1, 8))

# Standard deviations of joint angles (rad) of the pose reward.
_STD_WALKING = {
    r".*hip_pitch.*": 0.3,
    r".*hip_roll.*": 0.15,
    r".*hip_yaw.*": 0.15,
    r".*knee.*": 0.35,
    r".*ankle_pitch.*": 0.25,
    r".*ankle_roll.*": 0.1,
    r".*waist_yaw.*": 0.2,
    r".*waist_roll.*": 0.08,
    r".*waist_pitch.*": 0.1,
    r".*shoulder_pitch.*": 0.15,
    r".*shoulder_roll.*": 0.15,
    r".*shoulder_yaw.*": 0.1,
    r".*elbow.*": 0.15,
    r".*wrist.*": 0.3,
}
_STD_RUNNING = {
    r".*hip_pitch.*": 0.5,
    r".*hip_roll.*": 0.2,
    r".*hip_yaw.*": 0.2,
    r".*knee.*": 0.6,
    r".*ankle_pitch.*": 0.35,
    r".*ankle_roll.*": 0.15,
    r".*waist_yaw.*": 0.3,
    r".*waist_roll.*": 0.08,
    r".*waist_pitch.*": 0.2,
    r".*shoulder_pitch.*": 0.5,
    r".*shoulder_roll.*": 0.2,
    r".*shoulder_yaw.*": 0.15,
    r".*elbow.*": 0.35,
    r".*wrist.*": 0.3,
}


_SELF_COLLISION = ContactSensorCfg(
    name="self_collision",
    primary=ContactMatch(mode="subtree", pattern="pelvis", entity="robot"),
    secondary=ContactMatch(mode="subtree", pattern="pelvis", entity="robot"),
    fields=("found", "force"),
    reduce="maxforce",
    num_slots=1,
    history_length=4,
)


def unitree_g1_rough_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the rough-terrain task, for training or for `play`."""
    cfg = make_legged_env_cfg(
        get_g1_robot_cfg(),
        trunk="torso_link",
        base="pelvis",
        feet=_FEET,
        soles=_FOOT_GEOMS,
        foot_contacts=ContactMatch(
            mode="subtree",
            pattern=r"^(left_ankle_roll_link|right_ankle_roll_link)$",
            entity="robot",
        ),
        foot_rays=RingPatternCfg.single_ring(radius=0.03, num_samples=6),
        action_scale=dict(G1_ACTION_SCALE),
        std_standing={".*": 0.05},
        std_walking=dict(_STD_WALKING),
        std_running=dict(_STD_RUNNING),
    )
    cfg.sim.mujoco.ccd_iterations = 500
    cfg.sim.contact_sensor_maxmatch = 500
    cfg.sim.nconmax = 70
    cfg.scene.sensors += (copy.deepcopy(_SELF_COLLISION),)
    twist = cfg.commands["twist"]
    assert isinstance(twist, mdp.UniformVelocityCommandCfg)
    # Draw the command above the head.
    twist.viz.z_offset = 1.15
    cfg.rewards["body_ang_vel"].weight = -0.05
    cfg.rewards["angular_momentum"].weight = -0.02
    cfg.rewards["self_collisions"] = RewardTermCfg(
        func=mdp.self_collision_cost,
        weight=-1.0,
        params={"sensor_name": "self_collision", "force_threshold": 10.0},
    )
    if play:
        make_playable(cfg)
    return cfg


def unitree_g1_flat_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the flat-ground task, for training or for `play`."""
    cfg = unitree_g1_rough_env_cfg(play=play)
    make_flat(cfg, play)
    return cfg


def unitree_g1_flat_no_state_estimation_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the flat-ground task without base velocity in the actor's observations."""
    cfg = unitree_g1_flat_env_cfg(play=play)
    remove_state_estimation(cfg)
    return cfg


def unitree_g1_rough_no_state_estimation_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the rough-terrain task without base velocity and height scan in the actor's observations."""
    cfg = unitree_g1_rough_env_cfg(play=play)
    remove_state_estimation(cfg)
    return cfg
