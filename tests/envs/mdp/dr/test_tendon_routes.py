"""Spatial tendons follow what they run through: constants are those of a model compiled so."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.envs.mdp import dr
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg

# From a fixed hook around a cylinder to an arm, with a motor on the tendon and one on its site.
ROBOT = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="post">
      <geom size=".05" mass="1"/>
      <site name="hook" pos="0 0 .5"/>
      <body name="arm" pos="0 0 .1">
        <joint name="hinge" axis="0 1 0" armature=".01"/>
        <geom size=".05" pos=".2 0 0" mass=".5"/>
        <geom name="drum" type="cylinder" size=".04 .1" pos=".15 0 .26" euler="1.5708 0 0" mass="0"/>
        <site name="side" pos=".15 0 .36"/>
        <body name="hand" pos=".3 0 0">
          <joint name="wrist" axis="0 1 0" armature=".01"/>
          <geom size=".04" pos=".05 0 0" mass=".2"/>
          <site name="grip" pos=".1 0 .03"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="rope" stiffness="10" springlength=".2">
      <site site="hook"/><geom geom="drum" sidesite="side"/><site site="grip"/>
    </spatial>
  </tendon>
  <actuator>
    <motor name="pull" tendon="rope"/>
    <motor name="push" site="grip" gear="1 0 .5 0 .2 0"/>
  </actuator>
</mujoco>
"""
CONSTANTS = ("tendon_length0", "tendon_invweight0", "actuator_acc0")
NEAR: dict[str, Any] = {"ranges": (-0.02, 0.02), "operation": "add"}
TURN: dict[str, Any] = {f"{axis}_range": (-0.3, 0.3) for axis in ("roll", "pitch", "yaw")}

CASES: dict[str, tuple[Any, dict[str, Any]]] = {
    "site_pos": (dr.site_pos, NEAR | {"asset_cfg": SceneEntityCfg("robot", site_names=("grip",))}),
    "site_quat": (
        dr.site_quat,
        TURN | {"asset_cfg": SceneEntityCfg("robot", site_names=("grip",))},
    ),
    "geom_pos": (dr.geom_pos, NEAR | {"asset_cfg": SceneEntityCfg("robot", geom_names=("drum",))}),
    "geom_quat": (
        dr.geom_quat,
        TURN | {"asset_cfg": SceneEntityCfg("robot", geom_names=("drum",))},
    ),
    "geom_size": (
        dr.geom_size,
        {"ranges": (0.5, 1.3), "asset_cfg": SceneEntityCfg("robot", geom_names=("drum",))},
    ),
}


def compiled(world: Any, case: str, env: int) -> mujoco.MjModel:
    """Return a model compiled with the values that one environment has."""
    spec = mujoco.MjSpec.from_string(ROBOT)
    kind, _, attribute = case.partition("_")
    name = "grip" if kind == "site" else "drum"
    element = getattr(spec, kind)(name)
    index = getattr(world.sim.mj_model, kind)(name).id
    if attribute == "quat":
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    values = getattr(world.sim.model, case)[env, index].double().numpy()
    getattr(element, attribute)[:] = values
    return spec.compile()


@pytest.mark.parametrize("mode", ["startup", "reset"])
@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("case", CASES)
def test_constants_are_those_of_a_model_compiled_so(world_factory, case, engine, mode):
    torch.manual_seed(2)
    world = world_factory(ROBOT, num_envs=3, engine=engine)
    function, params = CASES[case]
    params["asset_cfg"].resolve(world.scene)
    manager = world.events(moved=EventTermCfg(func=function, mode=mode, params=params))
    before = {name: getattr(world.sim.model, name).clone() for name in CONSTANTS}
    some = torch.tensor([0, 2])
    if mode == "reset":
        manager.apply("reset", env_ids=some, global_env_step_count=0)
    else:
        manager.apply("startup")
    for env in range(3) if mode == "startup" else some.tolist():
        expected = compiled(world, case, env)
        for name in CONSTANTS:
            found = getattr(world.sim.model, name)[env].numpy()
            np.testing.assert_allclose(found, getattr(expected, name), rtol=2e-4, atol=1e-5)
    moved = [
        name
        for name in CONSTANTS
        if (getattr(world.sim.model, name)[0] - before[name][0]).abs().max() > 1e-4
    ]
    assert moved
    if mode == "reset":
        for name in CONSTANTS:
            assert torch.equal(getattr(world.sim.model, name)[1], before[name][1])
