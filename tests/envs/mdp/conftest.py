"""A world of one entity with physics but without managers, for tests of terms."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mujoco
import pytest
import torch

from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.managers.event_manager import EventManager, EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg

ROBOT_XML = """
<mujoco>
  <compiler angle="radian"/>
  <asset>
    <texture name="tex_a" type="2d" builtin="flat" width="4" height="4"/>
    <texture name="tex_b" type="2d" builtin="flat" width="4" height="4"/>
    <material name="mat_a" texture="tex_a"/>
    <material name="mat_b"/>
    <mesh name="tetra" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/>
  </asset>
  <worldbody>
    <body name="torso" pos="0 0 1">
      <freejoint name="root"/>
      <inertial pos=".01 .02 .03" quat=".9 .1 .2 .3" mass="3" diaginertia=".05 .04 .03"/>
      <geom name="box" type="box" size=".1 .2 .3" material="mat_a"/>
      <geom name="sphere" type="sphere" size=".1" pos=".5 0 0"/>
      <geom name="tetra" type="mesh" mesh="tetra"/>
      <site name="imu" pos="0 0 .1"/>
      <camera name="eye" pos=".1 0 0" focal=".01 .01" sensorsize=".02 .02" resolution="8 8"/>
      <light name="lamp" pos="0 0 2" dir="0 0 -1"/>
      <body name="thigh" pos="0 0 -.3">
        <joint name="hip" axis="0 1 0" range="-1 1" damping=".1" armature=".02" stiffness="2"/>
        <geom name="capsule" type="capsule" size=".05 .1" mass="1"/>
        <body name="shin" pos="0 0 -.3">
          <joint name="knee" axis="0 1 0" range="-2 .5" damping=".2" armature=".03"/>
          <geom name="cylinder" type="cylinder" size=".05 .1" mass=".5"/>
          <body name="foot" pos="0 0 -.2">
            <joint name="ankle" axis="0 1 0" damping=".3"/>
            <geom name="ellipsoid" type="ellipsoid" size=".05 .06 .07" mass=".2"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair name="self" geom1="box" geom2="ellipsoid" friction="1 .9 .01 .001 .002"/>
  </contact>
  <tendon>
    <fixed name="cable" damping=".1" stiffness="3"><joint joint="hip" coef="1"/></fixed>
  </tendon>
</mujoco>
"""

CART_XML = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-1 1"/>
      <geom name="cart" type="box" size=".2 .1 .1" mass="1"/>
      <body name="pole">
        <joint name="hinge" axis="0 1 0" damping=".01"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 1" size=".05" mass=".1"/>
        <site name="tip" pos="0 0 1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="rope"><joint joint="hinge" coef="1"/></fixed>
  </tendon>
</mujoco>
"""


class FakeScene(dict):
    """Entities and sensors by name, with what terms read of a scene."""

    def __init__(self, num_envs: int, **members: Any) -> None:
        super().__init__(**members)
        self.entities = dict(members)
        self.env_origins = torch.zeros(num_envs, 3)
        self.terrain: Any = None

    def place_cameras(self, *_: Any, **__: Any) -> None:
        """Do nothing: no camera belongs to the world."""


class World:
    """The attributes of an environment that terms read."""

    def __init__(self, cfg: EntityCfg, num_envs: int, engine: Any) -> None:
        self.num_envs = num_envs
        self.device = "cpu"
        entity = cfg.build()
        sim_cfg = SimulationCfg(engine=engine, mujoco=MujocoCfg(timestep=0.005))
        self.sim = Simulation(num_envs, sim_cfg, device="cpu", spec=entity.spec)
        entity.initialize(self.sim.mj_model, self.sim.model, self.sim.data, self.device)
        self.robot = entity
        self.scene = FakeScene(num_envs, robot=entity)
        self.step_dt = 0.02
        self.common_step_counter = 0
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.max_episode_length = 10

    def apply(
        self, func: Callable[..., Any], env_ids: torch.Tensor | None = None, **params: Any
    ) -> Any:
        """Run a term as the event manager would: fields expanded, selections resolved."""
        for value in params.values():
            if isinstance(value, SceneEntityCfg):
                value.resolve(self.scene)
        self.sim.expand_model_fields(getattr(func, "model_fields", ()))
        result = func(self, env_ids, **params)
        self.sim.recompute_constants(getattr(func, "recompute", 0))
        return result

    def events(self, **terms: EventTermCfg) -> EventManager:
        """Build an event manager, and expand what its terms declare."""
        manager = EventManager(terms, self)  # ty: ignore[invalid-argument-type]
        self.sim.expand_model_fields(manager.domain_randomization_fields)
        return manager


WorldFactory = Callable[..., World]


def build_world(
    xml: str = ROBOT_XML,
    num_envs: int = 4,
    engine: str = "native",
    actuators: tuple[Any, ...] = (),
    **cfg: Any,
) -> World:
    """Make a world from an XML, with actuators if wanted."""
    articulation = EntityArticulationInfoCfg(actuators=actuators, soft_joint_pos_limit_factor=0.9)
    entity_cfg = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(xml), articulation=articulation, **cfg
    )
    return World(entity_cfg, num_envs, engine)


@pytest.fixture(scope="session")
def world_factory() -> WorldFactory:
    """Return `build_world`, for worlds that several tests share."""
    return build_world


@pytest.fixture
def make_world() -> WorldFactory:
    """Return `build_world`, with the generator seeded."""
    torch.manual_seed(0)
    return build_world


@pytest.fixture
def world_of() -> type[World]:
    """Make a world of an entity's config, with the generator seeded."""
    torch.manual_seed(0)
    return World


@pytest.fixture
def make_cart(make_world: WorldFactory) -> WorldFactory:
    """Make a cart with a pole: a fixed base with a slide and a hinge."""
    return lambda **kwargs: make_world(CART_XML, **kwargs)


@pytest.fixture
def namespace() -> type[SimpleNamespace]:
    """Make stand-ins for managers."""
    return SimpleNamespace
