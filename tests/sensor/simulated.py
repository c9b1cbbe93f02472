"""Scenes bound to a simulation, for tests of sensors."""

from __future__ import annotations

from mjlab.scene import Scene
from mjlab.sim import Simulation, SimulationCfg


def simulation_of(scene: Scene, cfg: SimulationCfg) -> Simulation:
    """Return a simulation of the scene, whose sensors it feeds."""
    sim = Simulation(scene.num_envs, cfg, spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.add_forward_callback(scene.invalidate_sensor_caches)
    if scene.sensor_context is not None:
        sim.set_sensor_context(scene.sensor_context)
    return sim


def sense(sim: Simulation) -> None:
    sim.forward()
    sim.sense()
