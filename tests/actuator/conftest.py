"""A small arm with every kind of target, in a real simulation on the native engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import pytest
import torch

from mjlab.actuator import ActuatorCfg
from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg
from mjlab.sim import SimulationCfg
from mjlab.sim.simulation import Simulation

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base">
      <geom size="0.05"/>
      <body name="upper">
        <joint name="hip" axis="0 1 0" range="-1 1"/>
        <geom size="0.05" pos="0.2 0 0"/>
        <body name="lower" pos="0.4 0 0">
          <joint name="knee" axis="0 1 0" range="-2 2"/>
          <geom size="0.05" pos="0.2 0 0"/>
          <body name="foot" pos="0.4 0 0">
            <joint name="ankle" axis="0 1 0"/>
            <geom size="0.05" pos="0.1 0 0"/>
            <site name="toe" pos="0.2 0 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cord"><joint joint="hip" coef="1"/><joint joint="knee" coef="-0.5"/></fixed>
  </tendon>
  {extra}
</mujoco>
"""


@dataclass
class World:
    """An entity, alone in a simulation."""

    entity: Entity
    sim: Simulation

    @property
    def ctrl(self) -> torch.Tensor:
        return self.sim.data.ctrl

    def set_state(self, pos: Any, vel: Any) -> None:
        self.sim.data.qpos[:] = torch.as_tensor(pos)
        self.sim.data.qvel[:] = torch.as_tensor(vel)
        self.sim.forward()

    def force(self) -> torch.Tensor:
        """Write controls and return the scalar force of every actuator, (N, nu)."""
        self.entity.write_data_to_sim()
        self.sim.forward()
        return self.sim.data.actuator_force.clone()


def build_world(
    *actuators: ActuatorCfg, num_envs: int = 3, sort: bool = False, extra: str = "", xml: str = ARM
) -> World:
    text = xml.replace("{extra}", extra)
    entity = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(text),
        articulation=EntityArticulationInfoCfg(actuators=actuators),
        sort_actuators=sort,
    ).build()
    model = entity.compile()
    sim = Simulation(num_envs, SimulationCfg(), model, device="cpu")
    entity.initialize(model, sim.model, sim.data, "cpu")
    # Fields that are read later read as zero until they have been bound once.
    _ = sim.data.actuator_force, sim.data.qfrc_actuator, sim.data.ten_length, sim.data.ten_velocity
    sim.forward()
    return World(entity, sim)


@pytest.fixture(scope="session")
def make_world() -> Any:
    return build_world
