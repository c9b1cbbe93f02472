"""Models and simulations for the scene tests."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import pytest

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg

BOX = """
<mujoco model="box">{option}
  <worldbody><body name="box"><freejoint name="root"/>
    <geom name="hull" size=".1"/><site name="imu"/></body></worldbody>
  <sensor><gyro name="spin" site="imu"/><accelerometer site="imu"/></sensor>
</mujoco>
"""

CART = """
<mujoco model="cart">{option}
  <worldbody><body name="cart"><joint name="slider" type="slide" axis="1 0 0"/>
    <geom size=".1"/></body></worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
</mujoco>
"""

BARE_CART = CART.replace('<actuator><motor name="push" joint="slider"/></actuator>', "")


def cfg(xml: str, option: str = "", **fields) -> EntityCfg:
    text = xml.format(option=f"<option {option}" if option else "")
    return EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(text), **fields)


def make(**fields) -> tuple[Simulation, Scene]:
    scene = Scene(SceneCfg(**fields), device="cpu")
    sim = Simulation(scene.num_envs, SimulationCfg(), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.add_forward_callback(scene.invalidate_sensor_caches)
    return sim, scene


@pytest.fixture
def kit() -> SimpleNamespace:
    """The helpers of this file. `cfg(xml, 'timestep=".01"/>')` adds an option block."""
    return SimpleNamespace(BOX=BOX, CART=CART, BARE_CART=BARE_CART, cfg=cfg, make=make)
