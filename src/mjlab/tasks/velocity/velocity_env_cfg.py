"""Base config of the velocity task: track commanded linear velocity and yaw rate.

A robot package calls `make_velocity_env_cfg()` and fills in robot-specific settings: entity, feet,
sensors, gains. See `config/go1` and `config/g1`. `make_flat` and `make_playable` adapt the config of
any robot to flat ground and to play mode.
"""

from __future__ import annotations

import copy
import math
from typing import Any

from mjlab.compat import offers_older_sites
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import (
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    MetricsTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.scene import SceneCfg
from mjlab.sensor import GridPatternCfg, ObjRef, RayCastSensorCfg, SensorCfg, TerrainHeightSensorCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.velocity import mdp
from mjlab.terrains import TerrainEntityCfg
from mjlab.terrains.config import ROUGH_TERRAINS_CFG
from mjlab.utils.errors import UnknownNameError
from mjlab.utils.noise import UniformNoiseCfg
from mjlab.utils.string import suggest
from mjlab.viewer import ViewerConfig

# Placeholder that robot packages replace.
_NO_NAMES: tuple[str, ...] = ()


@offers_older_sites
def make_velocity_env_cfg() -> ManagerBasedRlEnvCfg:
    """Return a new config of the rough-terrain task, without a robot.

    The config shares no objects with other configs and may be edited freely. Fill in:

    - `scene.entities["robot"]`, the frames of the sensors `terrain_scan` and `foot_height_scan`
      and the latter's pattern, and a contact sensor `feet_ground_contact`;
    - the action's scale; the bodies, geoms and sites of `foot_friction`, `base_com`, `upright`,
      `body_ang_vel`, `foot_clearance` and `foot_slip`; and the standard deviations of `pose`;
    - `viewer.body_name`.

    Empty names of sensors and rewards raise `ValueError` when the environment is built. Empty names of
    events, and of rewards of weight 0 (here `body_ang_vel` and `angular_momentum`), only log a
    warning. Such events have no effect; such rewards raise once they get a nonzero weight.
    """
    return ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=20.0,
        scene=SceneCfg(
            terrain=TerrainEntityCfg(
                terrain_type="generator",
                terrain_generator=copy.deepcopy(ROUGH_TERRAINS_CFG),
                max_init_terrain_level=5,
            ),
            sensors=_sensors(),
            num_envs=1,
            extent=2.0,
        ),
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
        curriculum=_curriculum(),
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


def make_flat(cfg: ManagerBasedRlEnvCfg, play: bool) -> None:
    """Convert a rough-terrain config to flat ground, in place.

    Removes terrain sensing and terrain generation, and reduces contact memory. In play mode, command
    ranges are those of the second curriculum stage.
    """
    cfg.sim.njmax = 300
    cfg.sim.nconmax = None
    cfg.sim.contact_sensor_maxmatch = 64
    cfg.sim.mujoco.ccd_iterations = 50
    terrain = cfg.scene.terrain
    assert terrain is not None
    terrain.terrain_type = "plane"
    terrain.terrain_generator = None
    remove_sensors(cfg, "terrain_scan")
    for group in ("actor", "critic"):
        observations = cfg.observations[group]
        assert observations is not None
        observations.terms.pop("height_scan", None)
    upright = cfg.rewards["upright"]
    assert upright is not None
    upright.params.pop("terrain_sensor_names", None)
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
    actor = cfg.observations["actor"]
    assert actor is not None
    actor.enable_corruption = False
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


# Config sections.


def _sensors() -> tuple[SensorCfg, ...]:
    terrain_scan = RayCastSensorCfg(
        name="terrain_scan",
        frame=ObjRef(type="body", name="", entity="robot"),
        pattern=GridPatternCfg(size=(1.6, 1.0), resolution=0.1),
        ray_alignment="yaw",
        max_distance=5.0,
        # Terrain only: geoms of the robot are in other groups.
        include_geom_groups=(0,),
        debug_vis=True,
    )
    foot_height_scan = TerrainHeightSensorCfg(
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
    return terrain_scan, foot_height_scan


def _observations() -> dict[str, ObservationGroupCfg | None]:
    actor: dict[str, ObservationTermCfg | None] = {
        "base_lin_vel": ObservationTermCfg(
            func=mdp.builtin_sensor,
            params={"sensor_name": "robot/imu_lin_vel"},
            noise=_noise(0.5),
        ),
        "base_ang_vel": ObservationTermCfg(
            func=mdp.builtin_sensor,
            params={"sensor_name": "robot/imu_ang_vel"},
            noise=_noise(0.2),
        ),
        "projected_gravity": ObservationTermCfg(func=mdp.projected_gravity, noise=_noise(0.05)),
        "joint_pos": ObservationTermCfg(
            func=mdp.joint_pos_rel, params={"biased": True}, noise=_noise(0.01)
        ),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel, noise=_noise(1.5)),
        "actions": ObservationTermCfg(func=mdp.last_action),
        "command": ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": "twist"}
        ),
        "height_scan": ObservationTermCfg(
            func=mdp.height_scan,
            params={"sensor_name": "terrain_scan"},
            noise=_noise(0.1),
            # 1 / max_distance of the rays.
            scale=1.0 / 5.0,
        ),
    }

    def foot_term(func: object, sensor_name: str) -> ObservationTermCfg:
        return ObservationTermCfg(func=func, params={"sensor_name": sensor_name})

    # The critic observes the actor's terms without noise (no corruption in its group) and without
    # encoder bias, and further foot terms.
    critic = {
        **copy.deepcopy(actor),
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel),
        "height_scan": ObservationTermCfg(
            func=mdp.height_scan, params={"sensor_name": "terrain_scan"}, scale=1.0 / 5.0
        ),
        "foot_height": foot_term(mdp.foot_height, "foot_height_scan"),
        "foot_air_time": foot_term(mdp.foot_air_time, "feet_ground_contact"),
        "foot_contact": foot_term(mdp.foot_contact, "feet_ground_contact"),
        "foot_contact_forces": foot_term(mdp.foot_contact_forces, "feet_ground_contact"),
    }
    return {
        "actor": ObservationGroupCfg(terms=actor, enable_corruption=True),
        "critic": ObservationGroupCfg(terms=critic),
    }


def _noise(size: float) -> UniformNoiseCfg:
    return UniformNoiseCfg(n_min=-size, n_max=size)


def _commands() -> dict[str, CommandTermCfg | None]:
    return {
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


def _events() -> dict[str, EventTermCfg | None]:
    return {
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


def _rewards() -> dict[str, RewardTermCfg | None]:
    def body_cfg() -> SceneEntityCfg:
        return SceneEntityCfg("robot", body_names=_NO_NAMES)

    def feet_cfg() -> SceneEntityCfg:
        return SceneEntityCfg("robot", site_names=_NO_NAMES)

    # No foot penalties for standing commands.
    commanded = {"command_name": "twist", "command_threshold": 0.05}
    return {
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
        "upright": RewardTermCfg(
            func=mdp.upright,
            weight=1.0,
            params={"std": math.sqrt(0.2), "asset_cfg": body_cfg()},
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
            params={"asset_cfg": body_cfg()},
        ),
        "angular_momentum": RewardTermCfg(
            func=mdp.angular_momentum_penalty,
            weight=0.0,
            params={"sensor_name": "robot/root_angmom"},
        ),
        "dof_pos_limits": RewardTermCfg(func=mdp.joint_pos_limits, weight=-1.0),
        "action_rate_l2": RewardTermCfg(func=mdp.action_rate_l2, weight=-0.1),
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
                **commanded,
                "asset_cfg": feet_cfg(),
            },
        ),
        "foot_swing_height": RewardTermCfg(
            func=mdp.feet_swing_height,
            weight=-0.25,
            params={
                "sensor_name": "feet_ground_contact",
                "height_sensor_name": "foot_height_scan",
                "target_height": 0.1,
                **commanded,
            },
        ),
        "foot_slip": RewardTermCfg(
            func=mdp.feet_slip,
            weight=-0.1,
            params={"sensor_name": "feet_ground_contact", **commanded, "asset_cfg": feet_cfg()},
        ),
        "soft_landing": RewardTermCfg(
            func=mdp.soft_landing,
            weight=-1e-5,
            params={"sensor_name": "feet_ground_contact", **commanded},
        ),
    }


def _terminations() -> dict[str, TerminationTermCfg | None]:
    return {
        "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
        "fell_over": TerminationTermCfg(
            func=mdp.bad_orientation, params={"limit_angle": math.radians(70.0)}
        ),
        # Leaving the terrain truncates, it does not terminate.
        "out_of_terrain_bounds": TerminationTermCfg(func=mdp.out_of_terrain_bounds, time_out=True),
    }


def _curriculum() -> dict[str, CurriculumTermCfg | None]:
    # Steps are environment steps: iterations times 24.
    stages: list[mdp.VelocityStage] = [
        {"step": 0, "lin_vel_x": (-1.0, 1.0), "ang_vel_z": (-0.5, 0.5)},
        {"step": 5000 * 24, "lin_vel_x": (-1.5, 2.0), "ang_vel_z": (-0.7, 0.7)},
        {"step": 10000 * 24, "lin_vel_x": (-2.0, 3.0)},
    ]
    return {
        "terrain_levels": CurriculumTermCfg(
            func=mdp.terrain_levels_vel, params={"command_name": "twist"}
        ),
        "command_vel": CurriculumTermCfg(
            func=mdp.commands_vel, params={"command_name": "twist", "velocity_stages": stages}
        ),
    }
