"""Base config of the velocity task: track commanded linear velocity and yaw rate.

`make_legged_env_cfg` returns the task of a robot, from the names of its parts; see `config/go1` and
`config/g1`. `make_flat`, `remove_state_estimation`, `randomize_drives` and `make_playable` adapt it to
flat ground, to the sensors and drives of a robot and to play mode. `make_velocity_env_cfg` returns the template, whose names
are left to fill in.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

from mjlab.entity import EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import (
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    MetricsTermCfg,
    ObservationGroupCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sensor import (
    ContactMatch,
    ContactSensorCfg,
    GridPatternCfg,
    ObjRef,
    RayCastSensorCfg,
    RingPatternCfg,
    SensorCfg,
    TerrainHeightSensorCfg,
)
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.terms import observation
from mjlab.tasks.velocity import mdp
from mjlab.terrains import TerrainEntityCfg
from mjlab.terrains.config import ROUGH_TERRAINS_CFG
from mjlab.utils.errors import UnknownNameError
from mjlab.utils.string import suggest
from mjlab.viewer import ViewerConfig

BLIND_HISTORY = 10
"""Number of steps that policies without height scan observe on terrain: a foot contact affects
measurements for about 0.2 s."""


def make_legged_env_cfg(
    robot: EntityCfg,
    *,
    trunk: str,
    base: str,
    feet: tuple[str, ...],
    soles: tuple[str, ...],
    foot_contacts: ContactMatch,
    foot_rays: RingPatternCfg,
    action_scale: float | dict[str, float],
    std_standing: dict[str, float],
    std_walking: dict[str, float],
    std_running: dict[str, float],
) -> ManagerBasedRlEnvCfg:
    """Return a new config of the rough-terrain task of a robot.

    The robot needs a floating base, MuJoCo sensors `imu_lin_vel`, `imu_ang_vel` and `root_angmom`, and
    geoms in groups other than 0, the group that rays hit.

    Args:
        robot: The robot.
        trunk: Body that is kept upright, whose center of mass is randomized, and that viewers follow.
        base: Body that the terrain scan is attached to.
        feet: Site of each foot, in model order.
        soles: Geoms of the feet, whose friction is randomized.
        foot_contacts: Elements whose ground contacts are those of each foot, in the order of `feet`.
        foot_rays: Rays from each foot site that measure its height.
        action_scale: Scale from actions to joint targets (rad), or one per joint name pattern.
        std_standing: Tolerance of joints around the default pose (rad) of standing commands, by joint
            name pattern; see `variable_posture`.
        std_walking: Tolerance of walking commands.
        std_running: Tolerance of running commands.
    """
    cfg = make_velocity_env_cfg()
    terrain, action = cfg.scene.terrain, cfg.actions["joint_pos"]
    assert terrain is not None
    assert terrain.terrain_generator is not None
    assert isinstance(action, mdp.JointPositionActionCfg)
    cfg.scene.entities = {"robot": robot}
    terrain.terrain_generator.curriculum = True
    get_sensor(cfg, "terrain_scan").frame = ObjRef(type="body", name=base, entity="robot")
    heights = get_sensor(cfg, "foot_height_scan")
    heights.frame = tuple(ObjRef(type="site", name=foot, entity="robot") for foot in feet)
    heights.pattern = foot_rays
    cfg.scene.sensors += (
        ContactSensorCfg(
            name="feet_ground_contact",
            primary=foot_contacts,
            secondary=ContactMatch(mode="body", pattern="terrain"),
            fields=("found", "force"),
            reduce="netforce",
            num_slots=1,
            track_air_time=True,
        ),
    )
    action.scale = action_scale
    cfg.events["foot_friction"].params["asset_cfg"].geom_names = soles
    cfg.events["base_com"].params["asset_cfg"].body_names = (trunk,)
    for name in ("upright", "body_ang_vel"):
        cfg.rewards[name].params["asset_cfg"].body_names = (trunk,)
    for name in ("foot_clearance", "foot_slip"):
        cfg.rewards[name].params["asset_cfg"].site_names = feet
    for term in (cfg.observations["critic"].terms["foot_height"], cfg.rewards["foot_swing_height"]):
        del term.params["asset_cfg"]
    cfg.rewards["pose"].params.update(
        std_standing=std_standing, std_walking=std_walking, std_running=std_running
    )
    cfg.viewer.body_name = trunk
    return cfg


def make_velocity_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return a new config of the rough-terrain task, without a robot.

    The config shares no objects with other configs and may be edited freely. Fill in:

    - `scene.entities["robot"]`, the frames of the sensors `terrain_scan` and `foot_height_scan`
      and the latter's pattern, and a contact sensor `feet_ground_contact`;
    - the action's scale; the bodies, geoms and sites of `foot_friction`, `base_com`, `upright`,
      `body_ang_vel`, `foot_clearance` and `foot_slip`; and the standard deviations of `pose`;
    - `viewer.body_name`.

    Sensors without a name raise `ValueError` when the environment is built; terms without names warn.
    """
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=20.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(
                terrain_type="generator",
                terrain_generator=ROUGH_TERRAINS_CFG,
                max_init_terrain_level=5,
            ),
            sensors=_SENSORS,
            num_envs=1,
            extent=2.0,
        ),
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
        curriculum=_CURRICULUM,
        metrics={"mean_action_acc": MetricsTermCfg(func=mdp.mean_action_acc)},
        sim=SimulationCfg(
            nconmax=35,
            njmax=1500,
            mujoco=MujocoCfg(timestep=0.005, iterations=10, ls_iterations=20),
        ),
        viewer=ViewerConfig(
            origin_type=ViewerConfig.OriginType.ASSET_BODY,
            entity_name="robot",
            body_name="",
            distance=3.0,
            elevation=-5.0,
        ),
    )
    # The sections are module constants.
    return copy.deepcopy(cfg)


def make_flat(cfg: ManagerBasedRlEnvCfg, play: bool) -> None:
    """Convert a rough-terrain config to flat ground, in place.

    Removes terrain sensing and terrain generation, and reduces contact memory. In play mode, command
    ranges are those of the second curriculum stage.
    """
    cfg.sim.njmax = 300
    cfg.sim.nconmax = None
    cfg.sim.contact_sensor_maxmatch = 64
    cfg.sim.mujoco.ccd_iterations = 50
    assert cfg.scene.terrain is not None
    cfg.scene.terrain.terrain_type, cfg.scene.terrain.terrain_generator = "plane", None
    remove_sensors(cfg, "terrain_scan")
    for group in ("actor", "critic"):
        cfg.observations[group].terms.pop("height_scan", None)
    cfg.rewards["upright"].params.pop("terrain_sensor_names", None)
    cfg.terminations.pop("out_of_terrain_bounds", None)
    cfg.curriculum.pop("terrain_levels", None)
    if play:
        twist = cfg.commands["twist"]
        assert isinstance(twist, mdp.UniformVelocityCommandCfg)
        twist.ranges.lin_vel_x = (-1.5, 2.0)
        twist.ranges.ang_vel_z = (-0.7, 0.7)


def make_playable(cfg: ManagerBasedRlEnvCfg) -> None:
    """Convert a training config to play mode, in place.

    Episodes are effectively infinite, observations without noise, and pushes and curricula disabled.
    The robot starts on a random cell of a small terrain grid.
    """
    cfg.episode_length_s = int(1e9)
    cfg.observations["actor"].enable_corruption = False
    cfg.events.pop("push_robot", None)
    cfg.terminations.pop("out_of_terrain_bounds", None)
    cfg.curriculum = {}
    # First event, because later reset events place the robot on the sampled terrain.
    randomize_terrain = EventTermCfg(func=mdp.randomize_terrain, mode="reset")
    cfg.events = {"randomize_terrain": randomize_terrain, **cfg.events}
    terrain = cfg.scene.terrain
    if terrain is not None and terrain.terrain_generator is not None:
        terrain.terrain_generator.curriculum = False
        terrain.terrain_generator.num_rows = 5
        terrain.terrain_generator.num_cols = 5
        terrain.terrain_generator.border_width = 10.0


def remove_state_estimation(cfg: ManagerBasedRlEnvCfg) -> None:
    """Let the actor observe only what a robot measures, in place.

    Removes base velocity and height scan from the group `actor`; the critic keeps both. On terrain,
    the actor observes the last `BLIND_HISTORY` steps.
    """
    actor = cfg.observations["actor"]
    del actor.terms["base_lin_vel"]
    if actor.terms.pop("height_scan", None) is not None:
        actor.history_length = BLIND_HISTORY


def randomize_drives(
    cfg: ManagerBasedRlEnvCfg, joint_friction: dict[str, tuple[float, float]] | None = None
) -> None:
    """Randomize what a model file does not say of a robot's drives, in place.

    Events of mode `startup` vary friction, armature, gains and peak torque of each joint; the latency
    of the commands is drawn at each reset. `mjlab fit-actuators` measures a robot's own values, and
    prints events of the same names with narrower ranges.

    Args:
        cfg: Task with position-controlled joints.
        joint_friction: Dry friction (N m or N) by joint name pattern. None: 0.75 to 1.25 times that of
            the model.
    """
    friction: dict[str, Any] = {"operation": "scale", "ranges": (0.75, 1.25)}
    if joint_friction is not None:
        friction = {"operation": "abs", "ranges": joint_friction}
    joints = SceneEntityCfg("robot", joint_names=(".*",))
    for name, func, params in (
        ("joint_friction", mdp.dr.joint_friction, friction),
        # Rotor inertias come from data sheets, or from rules.
        ("armature", mdp.dr.joint_armature, {"operation": "scale", "ranges": (0.8, 1.2)}),
        # Torque constants vary from motor to motor, and with temperature.
        ("gains", mdp.dr.pd_gains, {"kp_range": (0.9, 1.1), "kd_range": (0.9, 1.1)}),
        # Peak torque depends on the charge of the battery.
        ("motor_strength", mdp.dr.effort_limits, {"effort_limit_range": (0.9, 1.1)}),
    ):
        cfg.events[name] = EventTermCfg(
            func=func, mode="startup", params={"asset_cfg": copy.deepcopy(joints), **params}
        )
    # From measurement to torque, robots of this size need up to 15 ms: 0 to 15 ms, one lag per episode.
    robot, substeps = cfg.scene.entities["robot"], round(0.015 / cfg.sim.mujoco.timestep)
    assert robot.articulation is not None
    robot.articulation = dataclasses.replace(
        robot.articulation,
        actuators=tuple(
            dataclasses.replace(actuator, delay_max_lag=substeps, delay_hold_prob=1.0)
            for actuator in robot.articulation.actuators
        ),
    )


def get_sensor(cfg: ManagerBasedRlEnvCfg, name: str) -> Any:
    """Return the config of a scene sensor. Raises `KeyError` listing the available names."""
    for sensor in cfg.scene.sensors:
        if sensor.name == name:
            return sensor
    names = [sensor.name for sensor in cfg.scene.sensors]
    raise UnknownNameError(f"Unknown sensor {name!r}; {suggest(name, names)}")


def remove_sensors(cfg: ManagerBasedRlEnvCfg, *names: str) -> None:
    """Remove sensors from the scene."""
    cfg.scene.sensors = tuple(s for s in cfg.scene.sensors if s.name not in names)


# Config sections. `make_velocity_env_cfg` copies them.

# Placeholder that robot packages replace.
_NO_NAMES: tuple[str, ...] = ()

_TERRAIN_SCAN = RayCastSensorCfg(
    name="terrain_scan",
    frame=ObjRef(type="body", name="", entity="robot"),
    pattern=GridPatternCfg(size=(1.6, 1.0), resolution=0.1),
    ray_alignment="yaw",
    max_distance=5.0,
    # Terrain only: geoms of the robot are in other groups.
    include_geom_groups=(0,),
    debug_vis=True,
)
_FOOT_HEIGHT_SCAN = TerrainHeightSensorCfg(
    name="foot_height_scan",
    frame=(),
    ray_alignment="yaw",
    max_distance=1.0,
    include_geom_groups=(0,),
    debug_vis=True,
    viz=TerrainHeightSensorCfg.VizCfg(
        hit_color=(1.0, 0.0, 1.0, 0.8), hit_sphere_color=(1.0, 0.0, 1.0, 1.0), show_rays=True
    ),
)
_SENSORS: tuple[SensorCfg, ...] = (_TERRAIN_SCAN, _FOOT_HEIGHT_SCAN)


# 1 / max_distance of the rays.
_SCAN_SCALE = 1.0 / 5.0
_ACTOR_TERMS = {
    "base_lin_vel": observation(mdp.builtin_sensor, 0.5, sensor_name="robot/imu_lin_vel"),
    "base_ang_vel": observation(mdp.builtin_sensor, 0.2, sensor_name="robot/imu_ang_vel"),
    "projected_gravity": observation(mdp.projected_gravity, 0.05),
    "joint_pos": observation(mdp.joint_pos_rel, 0.01, biased=True),
    "joint_vel": observation(mdp.joint_vel_rel, 1.5),
    "actions": observation(mdp.last_action),
    "command": observation(mdp.generated_commands, command_name="twist"),
    "height_scan": observation(mdp.height_scan, 0.1, _SCAN_SCALE, sensor_name="terrain_scan"),
}
# The critic observes the actor's terms without noise (no corruption in its group) and without
# encoder bias, and further foot terms.
_CRITIC_TERMS = {
    **copy.deepcopy(_ACTOR_TERMS),
    "joint_pos": observation(mdp.joint_pos_rel),
    "height_scan": observation(mdp.height_scan, None, _SCAN_SCALE, sensor_name="terrain_scan"),
    "foot_height": observation(
        mdp.foot_height,
        sensor_name="foot_height_scan",
        # Sites instead of the sensor, as in releases 1.1 and 1.2. Dropped if left empty.
        asset_cfg=SceneEntityCfg("robot", site_names=_NO_NAMES),
    ),
    "foot_air_time": observation(mdp.foot_air_time, sensor_name="feet_ground_contact"),
    "foot_contact": observation(mdp.foot_contact, sensor_name="feet_ground_contact"),
    "foot_contact_forces": observation(mdp.foot_contact_forces, sensor_name="feet_ground_contact"),
}

_COMMANDS: dict[str, CommandTermCfg] = {
    "twist": mdp.UniformVelocityCommandCfg(
        entity_name="robot",
        resampling_time_range=(3.0, 8.0),
        rel_standing_envs=0.1,
        rel_heading_envs=0.3,
        rel_forward_envs=0.2,
        heading_command=True,
        heading_control_stiffness=0.5,
        debug_vis=True,
        ranges=mdp.UniformVelocityCommandCfg.Ranges(
            lin_vel_x=(-1.0, 1.0),
            lin_vel_y=(-1.0, 1.0),
            ang_vel_z=(-0.5, 0.5),
            heading=(-math.pi, math.pi),
        ),
    )
}

_EVENTS: dict[str, EventTermCfg] = {
    "reset_base": EventTermCfg(
        func=mdp.reset_root_state_uniform,
        mode="reset",
        params={
            "pose_range": {
                "x": (-0.5, 0.5),
                "y": (-0.5, 0.5),
                "z": (0.01, 0.05),
                "yaw": (-3.14, 3.14),
            },
            "velocity_range": {},
        },
    ),
    "reset_robot_joints": EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={
            "position_range": (0.0, 0.0),
            "velocity_range": (0.0, 0.0),
            "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",)),
        },
    ),
    "push_robot": EventTermCfg(
        func=mdp.push_by_setting_velocity,
        mode="interval",
        interval_range_s=(1.0, 3.0),
        params={
            "velocity_range": {
                "x": (-0.5, 0.5),
                "y": (-0.5, 0.5),
                "z": (-0.4, 0.4),
                "roll": (-0.52, 0.52),
                "pitch": (-0.52, 0.52),
                "yaw": (-0.78, 0.78),
            }
        },
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
    "encoder_bias": EventTermCfg(
        func=mdp.dr.encoder_bias,
        mode="startup",
        params={"asset_cfg": SceneEntityCfg("robot"), "bias_range": (-0.015, 0.015)},
    ),
    "base_com": EventTermCfg(
        func=mdp.dr.body_com_offset,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names=_NO_NAMES),
            "operation": "add",
            "ranges": {0: (-0.025, 0.025), 1: (-0.025, 0.025), 2: (-0.03, 0.03)},
        },
    ),
}

# No foot penalties for standing commands.
_COMMANDED = {"command_name": "twist", "command_threshold": 0.05}
_REWARDS: dict[str, RewardTermCfg] = {
    # Tracking.
    "track_linear_velocity": RewardTermCfg(
        func=mdp.track_linear_velocity,
        weight=2.0,
        params={"command_name": "twist", "std": math.sqrt(0.25)},
    ),
    "track_angular_velocity": RewardTermCfg(
        func=mdp.track_angular_velocity,
        weight=2.0,
        params={"command_name": "twist", "std": math.sqrt(0.5)},
    ),
    # Posture and smoothness.
    "upright": RewardTermCfg(
        func=mdp.upright,
        weight=1.0,
        params={"std": math.sqrt(0.2), "asset_cfg": SceneEntityCfg("robot", body_names=_NO_NAMES)},
    ),
    "pose": RewardTermCfg(
        func=mdp.variable_posture,
        weight=1.0,
        params={
            "asset_cfg": SceneEntityCfg("robot", joint_names=(".*",)),
            "command_name": "twist",
            "std_standing": {},
            "std_walking": {},
            "std_running": {},
            "walking_threshold": 0.05,
            "running_threshold": 1.5,
        },
    ),
    "body_ang_vel": RewardTermCfg(
        func=mdp.body_angular_velocity_penalty,
        weight=0.0,
        params={"asset_cfg": SceneEntityCfg("robot", body_names=_NO_NAMES)},
    ),
    "angular_momentum": RewardTermCfg(
        func=mdp.angular_momentum_penalty,
        weight=0.0,
        params={"sensor_name": "robot/root_angmom"},
    ),
    "dof_pos_limits": RewardTermCfg(func=mdp.joint_pos_limits, weight=-1.0),
    "action_rate_l2": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.1),
    # Feet.
    "air_time": RewardTermCfg(
        func=mdp.feet_air_time,
        weight=0.0,
        params={
            "sensor_name": "feet_ground_contact",
            "threshold_min": 0.05,
            "threshold_max": 0.5,
            "command_name": "twist",
            "command_threshold": 0.5,
        },
    ),
    "foot_clearance": RewardTermCfg(
        func=mdp.feet_clearance,
        weight=-2.0,
        params={
            "target_height": 0.1,
            "height_sensor_name": "foot_height_scan",
            **_COMMANDED,
            "asset_cfg": SceneEntityCfg("robot", site_names=_NO_NAMES),
        },
    ),
    "foot_swing_height": RewardTermCfg(
        func=mdp.feet_swing_height,
        weight=-0.25,
        params={
            "sensor_name": "feet_ground_contact",
            "height_sensor_name": "foot_height_scan",
            "target_height": 0.1,
            **_COMMANDED,
            # As in `foot_height`.
            "asset_cfg": SceneEntityCfg("robot", site_names=_NO_NAMES),
        },
    ),
    "foot_slip": RewardTermCfg(
        func=mdp.feet_slip,
        weight=-0.1,
        params={
            "sensor_name": "feet_ground_contact",
            **_COMMANDED,
            "asset_cfg": SceneEntityCfg("robot", site_names=_NO_NAMES),
        },
    ),
    "soft_landing": RewardTermCfg(
        func=mdp.soft_landing,
        weight=-1e-5,
        params={"sensor_name": "feet_ground_contact", **_COMMANDED},
    ),
}

_TERMINATIONS: dict[str, TerminationTermCfg] = {
    "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
    "fell_over": TerminationTermCfg(
        func=mdp.bad_orientation, params={"limit_angle": math.radians(70.0)}
    ),
    # Leaving the terrain truncates, it does not terminate.
    "out_of_terrain_bounds": TerminationTermCfg(func=mdp.out_of_terrain_bounds, time_out=True),
}

# Steps are environment steps: iterations times 24.
_VELOCITY_STAGES: list[mdp.VelocityStage] = [
    {"step": 0, "lin_vel_x": (-1.0, 1.0), "ang_vel_z": (-0.5, 0.5)},
    {"step": 5000 * 24, "lin_vel_x": (-1.5, 2.0), "ang_vel_z": (-0.7, 0.7)},
    {"step": 10000 * 24, "lin_vel_x": (-2.0, 3.0)},
]
_CURRICULUM: dict[str, CurriculumTermCfg] = {
    "terrain_levels": CurriculumTermCfg(
        func=mdp.terrain_levels_vel, params={"command_name": "twist"}
    ),
    "command_vel": CurriculumTermCfg(
        func=mdp.commands_vel, params={"command_name": "twist", "velocity_stages": _VELOCITY_STAGES}
    ),
}
