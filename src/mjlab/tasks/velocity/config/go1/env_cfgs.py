"""Environment configs of the velocity tasks of the Unitree Go1."""

from __future__ import annotations

import copy
from typing import Literal

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_ACTION_SCALE
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg, RewardTermCfg, SceneEntityCfg, TerminationTermCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg, ObjRef, RingPatternCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.velocity_env_cfg import (
    get_sensor,
    make_flat,
    make_playable,
    make_velocity_env_cfg,
    remove_sensors,
)

TerrainType = Literal["rough", "obstacles"]
"""Terrain type of tasks on uneven ground."""

_TRUNK = "trunk"
# Model order, the order of contacts and sites.
_FEET = ("FR", "FL", "RR", "RL")
_FOOT_GEOMS = tuple(f"{foot}_foot_collision" for foot in _FEET)


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
        name="feet_ground_contact",
        primary=ContactMatch(mode="geom", pattern=_FOOT_GEOMS, entity="robot"),
        secondary=ContactMatch(mode="body", pattern="terrain"),
        fields=("found", "force"),
        reduce="netforce",
        num_slots=1,
        track_air_time=True,
    ),
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
    cfg = make_velocity_env_cfg()
    terrain, action = cfg.scene.terrain, cfg.actions["joint_pos"]
    assert terrain is not None
    assert terrain.terrain_generator is not None
    assert isinstance(action, mdp.JointPositionActionCfg)
    cfg.sim.mujoco.ccd_iterations = 500
    cfg.sim.mujoco.impratio = 10
    cfg.sim.mujoco.cone = "elliptic"
    cfg.sim.contact_sensor_maxmatch = 500
    cfg.scene.entities = {"robot": get_go1_robot_cfg()}
    terrain.terrain_generator.curriculum = True
    terrain_scan, foot_heights = (get_sensor(cfg, n) for n in ("terrain_scan", "foot_height_scan"))
    terrain_scan.frame = ObjRef(type="body", name=_TRUNK, entity="robot")
    foot_heights.frame = tuple(ObjRef(type="site", name=foot, entity="robot") for foot in _FEET)
    foot_heights.pattern = RingPatternCfg.single_ring(radius=0.04, num_samples=4)
    cfg.scene.sensors += copy.deepcopy(_CONTACT_SENSORS)
    action.scale = dict(GO1_ACTION_SCALE)
    cfg.events["base_com"].params["asset_cfg"].body_names = (_TRUNK,)
    # Feet have condim 6; torsional and rolling friction range over orders of magnitude.
    cfg.events.pop("foot_friction")
    cfg.events["foot_friction_slide"] = _foot_friction(0, (0.3, 1.5))
    cfg.events["foot_friction_spin"] = _foot_friction(1, (1e-4, 2e-2), "log_uniform")
    cfg.events["foot_friction_roll"] = _foot_friction(2, (1e-5, 5e-3), "log_uniform")
    _set_rewards(cfg)
    cfg.terminations.pop("fell_over")
    cfg.terminations["illegal_contact"] = TerminationTermCfg(
        func=mdp.illegal_contact, params={"sensor_name": "thigh_ground_touch"}
    )
    cfg.viewer.body_name = _TRUNK
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


def _set_rewards(cfg: ManagerBasedRlEnvCfg) -> None:
    params = {name: term.params for name, term in cfg.rewards.items()}
    params["upright"]["asset_cfg"].body_names = (_TRUNK,)
    # On slopes, the trunk should be parallel to the ground.
    params["upright"]["terrain_sensor_names"] = ("terrain_scan",)
    params["body_ang_vel"]["asset_cfg"].body_names = (_TRUNK,)
    for name in ("foot_clearance", "foot_slip"):
        params[name]["asset_cfg"].site_names = _FEET
    hips_and_thighs = r".*(FR|FL|RR|RL)_(hip|thigh)_joint.*"
    calves = r".*(FR|FL|RR|RL)_calf_joint.*"
    params["pose"]["std_standing"] = {hips_and_thighs: 0.05, calves: 0.1}
    params["pose"]["std_walking"] = {hips_and_thighs: 0.3, calves: 0.6}
    params["pose"]["std_running"] = {hips_and_thighs: 0.3, calves: 0.6}
    for name, sensor_name in (
        ("self_collisions", "self_collision"),
        ("shank_collision", "shank_ground_touch"),
        ("trunk_head_collision", "trunk_ground_touch"),
    ):
        cfg.rewards[name] = RewardTermCfg(
            func=mdp.self_collision_cost, weight=-0.1, params={"sensor_name": sensor_name}
        )
