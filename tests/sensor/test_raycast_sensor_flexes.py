"""Rays in models with flexes, which MuJoCo Warp does not have."""

from __future__ import annotations

import pytest
import torch

from mjlab.sensor import GridPatternCfg, RayCastSensorCfg
from mjlab.sim.engine import EngineUnavailableError

from .ray_scenes import BASE, ROBOT, scene_with, sense

CLOTH = """
<mujoco><worldbody>
  <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="3 0 1" dim="2" mass="1"
    radius=".01"><edge equality="true"/></flexcomp>
</worldbody></mujoco>
"""
ENTITIES = {"robot": ROBOT, "cloth": CLOTH}
DOWN = RayCastSensorCfg(name="down", frame=BASE, pattern=GridPatternCfg(size=(0.0, 0.0)))


def test_warp_rejects_rays_with_flexes():
    with pytest.raises(EngineUnavailableError, match="rays in a model with flexes.*native"):
        scene_with(DOWN, entities=ENTITIES, engine="warp")


def test_a_flex_alone_is_taken_by_warp_which_then_refuses_to_cast_rays():
    sim, scene = scene_with(entities=ENTITIES, engine="warp")
    assert scene.sensor_context is None
    rays = torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, 1.0]]])
    with pytest.raises(EngineUnavailableError, match="flexes"):
        sim.raycast(*rays)


def test_a_ray_sensor_and_a_flex_work_on_the_native_engine():
    sim, scene = scene_with(DOWN, entities=ENTITIES)
    assert sim.mj_model.nflex == 1
    sense(sim)
    # The top of the robot's foot is what lies below its base.
    assert scene["down"].data.distances.item() == pytest.approx(0.35, abs=1e-5)
