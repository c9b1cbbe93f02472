"""Models and simulations for the entity tests."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg

ROBOT = """
<mujoco model="robot">
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom name="trunk" type="box" size=".3 .2 .1" pos=".05 0 .02" euler=".1 .2 0"/>
      <site name="imu" pos=".1 .05 .1" euler=".3 0 .4"/>
      <body name="thigh" pos=".3 0 0">
        <joint name="hip" axis="0 1 0" range="-1 2"/>
        <geom name="thigh_geom" type="capsule" size=".04" fromto="0 0 0 .1 .2 -.3"/>
        <body name="shin" pos=".1 .2 -.3">
          <joint name="knee" axis="1 0 0"/>
          <geom type="capsule" size=".03" fromto="0 0 0 .2 0 -.2"/>
          <site name="foot" pos=".2 0 -.2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

ARM = """
<mujoco model="arm">
  <compiler angle="radian"/>
  <worldbody>
    <body name="link1" pos="0 0 .3">
      <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true"/>
      <geom type="capsule" size=".04" fromto="0 0 0 .4 0 0"/>
      <body name="link2" pos=".4 0 0">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
        <site name="tip" pos=".3 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cable"><joint joint="shoulder" coef=".5"/><joint joint="elbow" coef="-1"/></fixed>
  </tendon>
</mujoco>
"""

# Two trees under the world: MuJoCo refers velocities to the center of mass of each tree.
TWO_TREES = """
<mujoco model="two_trees">
  <worldbody>
    <body name="first"><freejoint name="root"/><geom size=".1" pos=".2 0 0"/></body>
    <body name="second" pos="2 0 0">
      <joint name="slide" type="slide" axis="0 0 1"/>
      <joint name="turn" axis="0 0 1" pos="0 .3 0"/>
      <geom size=".1" pos="0 .5 0" name="second_geom"/>
      <site name="second_site" pos=".3 .3 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def spec_of(xml: str) -> Callable[[], mujoco.MjSpec]:
    return lambda: mujoco.MjSpec.from_string(xml)


def simulate(scene: Scene) -> Simulation:
    sim = Simulation(scene.num_envs, SimulationCfg(), model=scene.compile(), device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.add_forward_callback(scene.invalidate_sensor_caches)
    return sim


def make(num_envs: int = 3, **entities: EntityCfg) -> tuple[Simulation, Scene]:
    scene = Scene(SceneCfg(num_envs=num_envs, entities=entities), device="cpu")
    return simulate(scene), scene


def randomize(sim: Simulation, seed: int = 0) -> list[mujoco.MjData]:
    """Give every environment another state, and return plain MuJoCo data in the same states."""
    rng = np.random.default_rng(seed)
    model = sim.mj_model
    references = []
    for env in range(sim.num_envs):
        data = mujoco.MjData(model)
        # Integrating a random velocity keeps quaternions on the unit sphere.
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.qvel[:] = rng.normal(size=model.nv)
        data.xfrc_applied[:] = rng.normal(size=(model.nbody, 6))
        sim.data.qpos[env] = torch.from_numpy(data.qpos).float()
        sim.data.qvel[env] = torch.from_numpy(data.qvel).float()
        sim.data.xfrc_applied[env] = torch.from_numpy(data.xfrc_applied).float()
        mujoco.mj_forward(model, data)
        references.append(data)
    sim.forward()
    return references


@pytest.fixture
def kit() -> SimpleNamespace:
    """The helpers of this file: test modules cannot import it."""
    return SimpleNamespace(
        ROBOT=ROBOT,
        ARM=ARM,
        TWO_TREES=TWO_TREES,
        spec_of=spec_of,
        cfg=lambda xml, **fields: EntityCfg(spec_fn=spec_of(xml), **fields),
        make=make,
        simulate=simulate,
        randomize=randomize,
    )
