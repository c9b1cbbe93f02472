"""Tests of the elements a sensor's frames resolve to."""

from __future__ import annotations

import mujoco
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import GridPatternCfg, ObjRef, RayCastSensorCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

BALL = """
<mujoco><worldbody><body name="ball" pos="0 0 2"><freejoint/><geom size=".5"/></body></worldbody>
</mujoco>
"""


def _rays_from(frame: ObjRef) -> torch.Tensor:
    """Return the distance that one ray measures upwards from a frame, in a world with a ground."""
    pattern = GridPatternCfg(size=(0.0, 0.0), direction=(0.0, 0.0, 1.0))
    sensor = RayCastSensorCfg(name="rays", frame=frame, pattern=pattern, ray_alignment="world")
    ball = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(BALL))
    cfg = SceneCfg(terrain=TerrainEntityCfg(), entities={"ball": ball}, sensors=(sensor,))
    scene = Scene(cfg, "cpu")
    sim = Simulation(1, SimulationCfg(), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.set_sensor_context(scene.sensor_context)
    sim.forward()
    sim.sense()
    return scene["rays"].data.distances


@pytest.mark.parametrize("kind", ["geom", "body"])
def test_rays_start_at_elements_of_the_terrain(kind):
    distances = _rays_from(ObjRef(kind, "terrain", entity="terrain"))
    torch.testing.assert_close(distances, torch.tensor([[1.5]]))


def test_what_belongs_to_another_entity_is_not_the_terrains():
    with pytest.raises(ValueError, match="body 'ball' in entity 'terrain'"):
        _rays_from(ObjRef("body", "ball", entity="terrain"))
