"""Environment configs of the velocity tasks of the Unitree Go1."""

from __future__ import annotations

import copy
from typing import Literal

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_ACTION_SCALE
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg, RewardTermCfg, SceneEntityCfg, TerminationTermCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg, RingPatternCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.velocity_env_cfg import (
    make_flat,
    make_legged_env_cfg,
    make_playable,
    make_velocity_env_cfg,
    remove_sensors,
    remove_state_estimation,
)

TerrainType = Literal["rough", "obstacles"]
"""Terrain type of tasks on uneven ground."""

_TRUNK = "trunk"
# Model order, the order of contacts and sites.
_FEET = ("FR", "FL", "RR", "RL")
_FOOT_GEOMS = tuple(f"{foot}_foot_collision" for foot in _FEET)
_HIPS_AND_THIGHS = r".*(FR|FL|RR|RL)_(hip|thigh)_joint.*"
_CALVES = r".*(FR|FL|RR|RL)_calf_joint.*"


def _touch(name: str, geoms: list[str]) -> ContactSensorCfg:
    """Return a sensor of the strongest ground contact of each geom, with a history of substeps."""
    return ContactSensorCfg(
        name=name,
        primary=ContactMatch(mode="geom", pattern=tuple(geoms), entity="robot"),
        secondary=ContactMatch(mode="body", pattern="terrain"),
        fields=("found", "force"),
        reduce="maxforce",
        num_slots=1,
        history_length=4,
    )


_CONTACT_SENSORS = (
    ContactSensorCfg(
        name="self_collision",
        primary=ContactMatch(mode="subtree", pattern=_TRUNK, entity="robot"),
        secondary=ContactMatch(mode="subtree", pattern=_TRUNK, entity="robot"),
        history_length=4,
    ),
    _touch("thigh_ground_touch", [f"{f}_thigh_collision{i}" for f in _FEET for i in (1, 2, 3)]),
    _touch("shank_ground_touch", [f"{f}_calf_collision{i}" for f in _FEET for i in (1, 2)]),
    _touch("trunk_ground_touch", ["trunk_collision", "head_collision"]),
)


def unitree_go1_rough_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the rough-terrain task, for training or for `play`."""
    cfg = make_legged_env_cfg(
        get_go1_robot_cfg(),
        trunk=_TRUNK,
        base=_TRUNK,
        feet=_FEET,
        soles=_FOOT_GEOMS,
        foot_contacts=ContactMatch(mode="geom", pattern=_FOOT_GEOMS, entity="robot"),
        foot_rays=RingPatternCfg.single_ring(radius=0.04, num_samples=4),
        action_scale=dict(GO1_ACTION_SCALE),
        std_standing={_HIPS_AND_THIGHS: 0.05, _CALVES: 0.1},
        std_walking={_HIPS_AND_THIGHS: 0.3, _CALVES: 0.6},
        std_running={_HIPS_AND_THIGHS: 0.3, _CALVES: 0.6},
    )
    cfg.sim.mujoco.ccd_iterations = 500
    cfg.sim.mujoco.impratio = 10
    cfg.sim.mujoco.cone = "elliptic"
    cfg.sim.contact_sensor_maxmatch = 500
    cfg.scene.sensors += copy.deepcopy(_CONTACT_SENSORS)
    # Feet have condim 6; torsional and rolling friction range over orders of magnitude.
    cfg.events.pop("foot_friction")
    cfg.events["foot_friction_slide"] = _foot_friction(0, (0.3, 1.5))
    cfg.events["foot_friction_spin"] = _foot_friction(1, (1e-4, 2e-2), "log_uniform")
    cfg.events["foot_friction_roll"] = _foot_friction(2, (1e-5, 5e-3), "log_uniform")
    # On slopes, the trunk should be parallel to the ground.
    cfg.rewards["upright"].params["terrain_sensor_names"] = ("terrain_scan",)
    for name, sensor_name in (
        ("self_collisions", "self_collision"),
        ("shank_collision", "shank_ground_touch"),
        ("trunk_head_collision", "trunk_ground_touch"),
    ):
        cfg.rewards[name] = RewardTermCfg(
            func=mdp.self_collision_cost, weight=-0.1, params={"sensor_name": sensor_name}
        )
    cfg.terminations.pop("fell_over")
    cfg.terminations["illegal_contact"] = TerminationTermCfg(
        func=mdp.illegal_contact, params={"sensor_name": "thigh_ground_touch"}
    )
    cfg.viewer.distance = 1.5
    cfg.viewer.elevation = -10.0
    if play:
        make_playable(cfg)
    return cfg


def unitree_go1_flat_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the flat-ground task, for training or for `play`."""
    cfg = unitree_go1_rough_env_cfg(play=play)
    make_flat(cfg, play)
    # On a plane, orientation alone detects falls.
    remove_sensors(
        cfg, "self_collision", "thigh_ground_touch", "shank_ground_touch", "trunk_ground_touch"
    )
    for name in ("self_collisions", "shank_collision", "trunk_head_collision"):
        cfg.rewards.pop(name)
    cfg.terminations.pop("illegal_contact")
    cfg.terminations["fell_over"] = make_velocity_env_cfg().terminations["fell_over"]
    return cfg


def unitree_go1_flat_no_state_estimation_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the flat-ground task without base velocity in the actor's observations."""
    cfg = unitree_go1_flat_env_cfg(play=play)
    remove_state_estimation(cfg)
    return cfg


def unitree_go1_rough_no_state_estimation_env_cfg(play: bool = False) -> ManagerBasedRlEnvCfg:
    """Return the rough-terrain task without base velocity and height scan in the actor's observations."""
    cfg = unitree_go1_rough_env_cfg(play=play)
    remove_state_estimation(cfg)
    return cfg


def _foot_friction(
    axis: int, ranges: tuple[float, float], distribution: str | None = None
) -> EventTermCfg:
    return EventTermCfg(
        func=mdp.dr.geom_friction,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", geom_names=_FOOT_GEOMS),
            "operation": "abs",
            **({} if distribution is None else {"distribution": distribution}),
            "axes": [axis],
            "ranges": ranges,
            "shared_random": True,
        },
    )
