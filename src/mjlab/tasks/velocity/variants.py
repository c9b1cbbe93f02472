"""What flat ground and playing change, whatever the robot."""

from __future__ import annotations

from typing import Any

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.managers import EventTermCfg
from mjlab.tasks.velocity import mdp


def get_sensor(cfg: ManagerBasedRlEnvCfg, name: str) -> Any:
    """Return the config of a sensor of the scene; raises `KeyError`, with the names, if unknown."""
    for sensor in cfg.scene.sensors:
        if sensor.name == name:
            return sensor
    raise KeyError(
        f"No sensor {name!r}; there are {[sensor.name for sensor in cfg.scene.sensors]}."
    )


def remove_sensors(cfg: ManagerBasedRlEnvCfg, *names: str) -> None:
    """Remove sensors from the scene."""
    cfg.scene.sensors = tuple(s for s in cfg.scene.sensors if s.name not in names)


def make_flat(cfg: ManagerBasedRlEnvCfg, play: bool) -> None:
    """Turn the config of a robot on rough terrain into that on flat ground.

    What sees the terrain, or belongs to a grid of it, goes; so does the memory that only many
    contacts need. To play, commands reach as far as in the second stage of the curriculum.
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
    """Turn a config to train with into one to look at what was learned.

    Episodes do not end by time, observations are without noise, nothing pushes, and the robot
    starts anywhere on a small grid of terrain.
    """
    cfg.episode_length_s = int(1e9)
    actor = cfg.observations["actor"]
    assert actor is not None
    actor.enable_corruption = False
    cfg.events.pop("push_robot", None)
    cfg.terminations.pop("out_of_terrain_bounds", None)
    cfg.curriculum = {}
    # First, so that the events after it put the robot onto the terrain that this one draws.
    randomize_terrain = EventTermCfg(func=mdp.randomize_terrain, mode="reset")
    cfg.events = {"randomize_terrain": randomize_terrain, **cfg.events}
    terrain = cfg.scene.terrain
    if terrain is not None and terrain.terrain_generator is not None:
        terrain.terrain_generator.curriculum = False
        terrain.terrain_generator.num_rows = 5
        terrain.terrain_generator.num_cols = 5
        terrain.terrain_generator.border_width = 10.0
