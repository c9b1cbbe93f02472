"""Randomized values take effect, equally on both engines."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch

from mjlab.actuator import (
    BuiltinMotorActuatorCfg,
    BuiltinPositionActuatorCfg,
    IdealPdActuatorCfg,
    TransmissionType,
)
from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg

# Lying on the ground, touching itself, with springs, dry friction, a tendon and a motor on a site.
ROBOT = """
<mujoco>
  <compiler angle="radian"/>
  <default><geom condim="6" friction=".8 .02 .002"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="torso" pos="0 0 .2">
      <freejoint/>
      <inertial pos=".01 .02 .03" quat=".9 .1 .2 .3" mass="3" diaginertia=".05 .04 .03"/>
      <geom name="box" type="box" size=".2 .15 .06"/>
      <geom name="ball" type="sphere" size=".06" pos=".25 0 0"/>
      <site name="jet" pos="0 .1 .06" euler=".3 .2 .1"/>
      <body name="thigh" pos="-.2 0 0">
        <joint name="hip" axis="0 1 0" range="-.3 .3" limited="true" damping=".1" armature=".02"
               stiffness="2" frictionloss=".05"/>
        <geom name="capsule" type="capsule" size=".03" fromto="-.05 0 0 -.2 0 0" mass="1"/>
        <body name="shin" pos="-.25 0 0">
          <joint name="knee" axis="0 1 0" damping=".2" armature=".03" frictionloss=".05"/>
          <geom name="rod" type="capsule" size=".02" fromto="-.05 0 0 -.2 0 0" mass=".5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><pair name="pair" geom1="floor" geom2="ball" condim="6"/></contact>
  <tendon>
    <fixed name="cable" damping=".1" stiffness="3" frictionloss=".05" armature=".01">
      <joint joint="hip" coef="1"/><joint joint="knee" coef="-1"/>
    </fixed>
  </tendon>
</mujoco>
"""
ACTUATORS = (
    BuiltinPositionActuatorCfg(
        target_names_expr=("hip",), stiffness=20.0, damping=2.0, effort_limit=2.0
    ),
    IdealPdActuatorCfg(target_names_expr=("knee",), stiffness=10.0, damping=1.0, effort_limit=1.5),
    BuiltinMotorActuatorCfg(
        target_names_expr=("jet",), transmission_type=TransmissionType.SITE, effort_limit=9.0
    ),
)
MOVING = {"geom_names": ("box", "ball", "capsule")}
TURN: dict[str, Any] = {f"{axis}_range": (-0.4, 0.4) for axis in ("roll", "pitch", "yaw")}
NEAR: dict[str, Any] = {"ranges": (-0.04, 0.04), "operation": "add"}
FACTOR: dict[str, Any] = {"ranges": (0.3, 3.0), "operation": "scale"}

CASES: dict[str, tuple[Any, dict[str, Any], dict[str, Any]]] = {
    "body_mass": (dr.body_mass, FACTOR, {"body_names": ("torso", "shin")}),
    "body_com_offset": (dr.body_com_offset, NEAR, {"body_names": ("torso",)}),
    "body_pos": (dr.body_pos, NEAR, {"body_names": ("thigh", "shin")}),
    "body_quat": (dr.body_quat, TURN, {"body_names": ("thigh",)}),
    "pseudo_inertia": (
        dr.pseudo_inertia,
        {"alpha_range": (-0.3, 0.3), "d_range": (-0.2, 0.2), "t_range": (-0.03, 0.03)},
        {"body_names": ("torso", "thigh")},
    ),
    "geom_friction": (dr.geom_friction, {"ranges": (0.05, 0.4)}, {"geom_names": (".*",)}),
    "geom_pos": (dr.geom_pos, NEAR, MOVING),
    "geom_quat": (dr.geom_quat, TURN, MOVING),
    "geom_size": (dr.geom_size, {"ranges": (0.8, 1.3)}, MOVING),
    "joint_armature": (dr.joint_armature, FACTOR, {"joint_names": (".*",)}),
    "joint_damping": (dr.joint_damping, FACTOR, {"joint_names": (".*",)}),
    "joint_friction": (dr.joint_friction, FACTOR, {"joint_names": (".*",)}),
    "joint_stiffness": (dr.joint_stiffness, FACTOR, {"joint_names": ("hip",)}),
    "joint_limits": (
        dr.joint_limits, {"ranges": {0: (-0.1, -0.02), 1: (0.02, 0.1)}}, {"joint_names": ("hip",)},
    ),
    "joint_default_pos": (dr.joint_default_pos, NEAR, {"joint_names": (".*",)}),
    "site_pos": (dr.site_pos, NEAR, {"site_names": ("jet",)}),
    "site_quat": (dr.site_quat, TURN, {"site_names": ("jet",)}),
    "tendon_armature": (dr.tendon_armature, FACTOR, {"tendon_names": ("cable",)}),
    "tendon_damping": (dr.tendon_damping, FACTOR, {"tendon_names": ("cable",)}),
    "tendon_stiffness": (dr.tendon_stiffness, FACTOR, {"tendon_names": ("cable",)}),
    "tendon_friction": (dr.tendon_friction, FACTOR, {"tendon_names": ("cable",)}),
    "pair_friction": (
        dr.pair_friction, {"ranges": (0.05, 0.4), "isotropic": True}, {"pair_names": ("pair",)},
    ),
    "pd_gains": (
        dr.pd_gains, {"kp_range": (0.3, 3.0), "kd_range": (0.3, 3.0)},
        {"actuator_names": ("hip", "knee")},
    ),
    "effort_limits": (
        dr.effort_limits, {"effort_limit_range": (0.1, 0.5)},
        {"actuator_names": ("hip", "knee", "jet")},
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def pair(world_factory: Any) -> tuple[Any, Any]:
    """One world on each engine, with all that is randomized here expanded."""
    worlds = tuple(
        world_factory(ROBOT, num_envs=3, engine=engine, actuators=ACTUATORS)
        for engine in ("native", "warp")
    )
    for world in worlds:
        for function, _, _ in CASES.values():
            world.sim.expand_model_fields(function.model_fields)
            world.sim.recompute_constants(function.recompute)
        _ = world.sim.data.qacc
    return worlds


def restore(world: Any) -> None:
    for field in world.sim.expanded_fields:
        getattr(world.sim.model, field)[:] = world.sim.get_default_field(field)
    ideal = world.robot.actuators[1]
    ideal.set_gains(None, ideal.default_stiffness, ideal.default_damping)
    ideal.set_effort_limit(None, ideal.default_force_limit)


def randomize(world: Any, case: str, only: torch.Tensor | None = None) -> None:
    function, params, names = CASES[case]
    torch.manual_seed(5)
    with warnings.catch_warnings():
        # Masses without inertias are what this asks for.
        warnings.simplefilter("ignore", UserWarning)
        world.apply(function, only, asset_cfg=SceneEntityCfg("robot", **names), **params)


def roll_out(world: Any) -> torch.Tensor:
    """Return positions and velocities after a short fall onto the ground, (N, nq + nv)."""
    sim = world.sim
    sim.reset()
    sim.data.qpos[:] = torch.tensor([0, 0, 0.055, 1, 0, 0.02, 0, 0.05, -0.1])
    sim.data.qvel[:] = torch.tensor([0.5, 0.3, -0.2, 0.3, 0.2, 1.0, 1.5, -2.0])
    world.robot.data.joint_pos_target[:] = 0.3
    world.robot.data.site_effort_target[:] = 6.0
    for _ in range(4):
        world.robot.write_data_to_sim()
        sim.step(3)
    return torch.cat((sim.data.qpos, sim.data.qvel), dim=1).clone()


@pytest.mark.parametrize("case", CASES)
def test_a_randomized_field_changes_the_motion_alike_on_both_engines(pair: Any, case: str) -> None:
    native, warp = pair
    for world in pair:
        restore(world)
        world.sim.recompute_constants(3)
    as_built = roll_out(native)
    changed = torch.tensor([0, 2])
    for world in pair:
        randomize(world, case, changed)
    moved, on_warp = roll_out(native), roll_out(warp)
    # The same draws reach the same fields.
    for field in native.sim.expanded_fields & warp.sim.expanded_fields:
        a, b = (getattr(world.sim.model, field) for world in pair)
        torch.testing.assert_close(a.float(), b.float(), atol=1e-5, rtol=1e-3, msg=field)
    scale = 1.0 + moved.abs().max()
    assert ((moved - on_warp).abs() / scale).max() < 5e-4
    difference = (moved - as_built).abs().amax(dim=1)
    assert (difference[changed] > 1e-4).all(), difference
    assert difference[1] == 0.0


def test_every_physical_function_of_the_table_is_covered() -> None:
    drawn_only = {"geom_rgba", "geom_matid", "mat_texid", "encoder_bias"}
    prefixes = ("cam_", "light_", "mat_")
    functions = {
        getattr(dr, name).__name__
        for name in dr.__all__
        if hasattr(getattr(dr, name), "model_fields") and not name.startswith(prefixes)
    }
    assert functions - drawn_only == set(CASES)
