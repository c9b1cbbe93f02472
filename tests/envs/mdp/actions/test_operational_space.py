"""Operational-space control: holds and reaches poses, its formula, and both engines."""

from __future__ import annotations

from typing import Any

import mujoco
import pytest
import torch

from mjlab.actuator import BuiltinMotorActuatorCfg, BuiltinPositionActuatorCfg, IdealPdActuatorCfg
from mjlab.entity import EntityCfg
from mjlab.envs.mdp import DifferentialIKActionCfg, OperationalSpaceControllerActionCfg
from mjlab.rl import exporter_utils
from mjlab.utils.lab_api.math import quat_box_plus, quat_error_magnitude

# An arm of six hinges with a heavy forearm, and a finger that the action does not control.
ARM_XML = """
<mujoco>
  <compiler angle="radian"/>
  <default><joint armature=".02"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="base">
      <geom type="box" size=".05 .05 .05"/>
      <body name="l1" pos="0 0 .1">
        <joint name="j1" axis="0 0 1"/><geom type="sphere" size=".03"/>
        <body name="l2" pos="0 0 .1">
          <joint name="j2" axis="0 1 0"/><geom type="capsule" size=".03" fromto="0 0 0 -.26 0 0"/>
          <body name="l3" pos="-.26 0 0">
            <joint name="j3" axis="0 -1 0"/>
            <geom type="capsule" size=".03" fromto="0 0 0 .25 0 .06"/>
            <body name="l4" pos=".25 0 .06">
              <joint name="j4" axis="0 -1 0"/><geom type="sphere" size=".03"/>
              <body name="l5" pos=".07 0 0">
                <joint name="j5" axis="0 0 1"/><geom type="sphere" size=".03"/>
                <body name="hand" pos=".04 0 0">
                  <joint name="j6" axis="1 0 0"/>
                  <geom type="box" size=".04 .03 .02" pos=".05 .01 0"/>
                  <site name="grasp" pos=".12 0 .01" euler=".3 -.2 .5"/>
                  <body name="finger" pos=".08 0 0">
                    <joint name="finger" type="slide" axis="0 1 0" stiffness="200" damping="5"/>
                    <geom type="sphere" size=".01"/>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")
HOME = dict(zip(JOINTS, (0.2, 1.0, 1.1, -0.4, 0.3, 0.5), strict=True))
MOTORS = BuiltinMotorActuatorCfg(target_names_expr=("j.*",), effort_limit=200.0)
NUM_ENVS = 3


def make_arm(make_world: Any, engine: str = "native", actuator: Any = MOTORS, xml: str = ARM_XML):
    state = EntityCfg.InitialStateCfg(joint_pos={**HOME, "finger": 0.0})
    arm = make_world(xml, num_envs=NUM_ENVS, engine=engine, actuators=(actuator,), init_state=state)
    arm.robot.write_joint_state_to_sim(
        arm.robot.data.default_joint_pos, arm.robot.data.default_joint_vel
    )
    arm.sim.forward()
    return arm


def term(arm: Any, **fields: Any) -> Any:
    fields = {"actuator_names": ("j.*",), "frame_type": "site", "frame_name": "grasp", **fields}
    osc = OperationalSpaceControllerActionCfg(entity_name="robot", **fields).build(arm)
    arm.sim.forward()
    return osc


def pose(arm: Any) -> tuple[torch.Tensor, torch.Tensor]:
    data = arm.robot.data
    return data.site_pos_w[:, 0].clone(), data.site_quat_w[:, 0].clone()


def run(osc: Any, arm: Any, action: torch.Tensor, seconds: float) -> None:
    """Control the arm with an absolute target, or with one relative action."""
    osc.process_actions(action.expand(NUM_ENVS, -1))
    for _ in range(round(seconds / 0.005)):
        osc.apply_actions()
        arm.robot.write_data_to_sim()
        arm.sim.step()
    arm.sim.forward()


def target(arm: Any, shift: tuple[float, ...], turn: tuple[float, ...]) -> torch.Tensor:
    position, quat = pose(arm)
    turned = quat_box_plus(quat, torch.tensor(turn).expand(NUM_ENVS, 3))
    return torch.cat((position + torch.tensor(shift), turned), dim=1)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_holds_its_pose(make_world: Any, engine: str) -> None:
    arm = make_arm(make_world, engine)
    osc = term(arm)
    position, quat = pose(arm)
    run(osc, arm, torch.zeros(1, 6), 0.2 if engine == "warp" else 1.0)
    assert (pose(arm)[0] - position).norm(dim=1).max() < 1e-3
    assert quat_error_magnitude(pose(arm)[1], quat).max() < 5e-3


@pytest.mark.parametrize(
    "actuator", [MOTORS, IdealPdActuatorCfg(target_names_expr=("j.*",), stiffness=50, damping=5)]
)
def test_reaches_a_commanded_pose(make_world: Any, actuator: Any) -> None:
    arm = make_arm(make_world, actuator=actuator)
    osc = term(arm, use_relative_mode=False)
    goal = target(arm, (-0.05, 0.08, 0.06), (0.3, -0.2, 0.4))
    run(osc, arm, goal, 1.5)
    position, quat = pose(arm)
    assert (position - goal[:, :3]).norm(dim=1).max() < 2e-3
    assert quat_error_magnitude(quat, goal[:, 3:]).max() < 1e-2


def test_the_error_decays_as_a_critically_damped_spring(make_world: Any) -> None:
    arm = make_arm(make_world)
    osc = term(arm, use_relative_mode=False, stiffness=100.0)
    goal = target(arm, (0.0, 0.1, 0.0), (0.0, 0.0, 0.0))
    run(osc, arm, goal, 0.2)
    left = (goal[:, 1] - pose(arm)[0][:, 1]) / 0.1
    # (1 + w t) exp(-w t), at w t = 2.
    torch.testing.assert_close(left, torch.full((NUM_ENVS,), 0.406), atol=0.04, rtol=0.0)


def test_the_posture_moves_a_free_arm_without_its_hand(make_world: Any) -> None:
    arm = make_arm(make_world)
    osc = term(arm, controls_orientation=False, use_relative_mode=False)
    arm.robot.data.default_joint_pos[:, 4] += 0.5
    position, _ = pose(arm)
    before = arm.robot.data.joint_pos[:, 4].clone()
    run(osc, arm, position, 2.0)
    assert (pose(arm)[0] - position).norm(dim=1).max() < 5e-3
    assert (arm.robot.data.joint_pos[:, 4] - before).min() > 0.1


def test_without_compensation_the_arm_sags(make_world: Any) -> None:
    arm = make_arm(make_world)
    osc = term(arm, gravity_compensation=False, use_relative_mode=False)
    goal = target(arm, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    run(osc, arm, goal, 1.0)
    # g / stiffness.
    torch.testing.assert_close(
        goal[:, 2] - pose(arm)[0][:, 2], torch.full((NUM_ENVS,), 9.81 / 150), atol=0.02, rtol=0.0
    )


def test_gravity_is_not_compensated_twice(make_world: Any) -> None:
    xml = ARM_XML.replace("<body name=", '<body gravcomp="1" name=')
    arm = make_arm(make_world, xml=xml)
    osc = term(arm)
    osc.process_actions(torch.zeros(NUM_ENVS, 6))
    assert osc.compute_efforts().abs().max() < 1e-3


@pytest.mark.parametrize(
    ("actuator", "match"),
    [
        (
            BuiltinPositionActuatorCfg(target_names_expr=("j.*",), stiffness=10.0, damping=1.0),
            "use BuiltinMotorActuatorCfg",
        ),
        (
            BuiltinMotorActuatorCfg(target_names_expr=("j.*",), effort_limit=9.0, gear=2.0),
            "gear 1",
        ),
    ],
)
def test_actuators_must_take_efforts(make_world: Any, actuator: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        term(make_arm(make_world, actuator=actuator))


@pytest.mark.parametrize(
    ("fields", "size"),
    [
        ({}, 6),
        ({"use_relative_mode": False}, 7),
        ({"controls_orientation": False}, 3),
        ({"controls_orientation": False, "use_relative_mode": False}, 3),
    ],
)
def test_the_size_says_what_the_target_is(make_world: Any, fields: Any, size: int) -> None:
    assert term(make_arm(make_world), **fields).action_dim == size


def test_relative_actions_are_scaled(make_world: Any) -> None:
    arm = make_arm(make_world)
    osc = term(arm, delta_pos_scale=0.1, delta_ori_scale=0.5, controls_orientation=True)
    position, quat = pose(arm)
    run(osc, arm, torch.tensor([[0.5, 0.0, 0.0, 0.0, 0.0, 1.0]]), 1.5)
    moved = pose(arm)
    torch.testing.assert_close(
        moved[0] - position, torch.tensor([[0.05, 0.0, 0.0]]).expand(3, 3), atol=3e-3, rtol=0.0
    )
    torch.testing.assert_close(
        quat_error_magnitude(moved[1], quat), torch.full((3,), 0.5), atol=0.02, rtol=0.0
    )


@pytest.mark.parametrize("kind", [OperationalSpaceControllerActionCfg, DifferentialIKActionCfg])
@pytest.mark.parametrize(
    ("relative", "scales"), [(True, [0.1] * 3 + [0.5] * 3), (False, [1.0] * 7)]
)
def test_the_exported_scale_is_that_of_relative_actions(
    make_world: Any, kind: Any, relative: bool, scales: list[float]
) -> None:
    cfg = kind(
        entity_name="robot",
        actuator_names=("j.*",),
        frame_name="hand",
        use_relative_mode=relative,
        delta_pos_scale=0.1,
        delta_ori_scale=0.5,
    )
    metadata = exporter_utils._action_metadata({"hand": cfg.build(make_arm(make_world))})
    assert metadata["action_scale"] == pytest.approx(scales)


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_mass_matrix(make_world: Any, engine: str) -> None:
    arm = make_arm(make_world, engine)
    sim, host = arm.sim, mujoco.MjData(arm.sim.mj_model)
    sim.mass_matrix()
    sim.data.qpos[:] = torch.randn(sim.data.qpos.shape, generator=torch.Generator().manual_seed(2))
    sim.forward()
    host.qpos[:] = sim.data.qpos[1].numpy()
    mujoco.mj_forward(sim.mj_model, host)
    expected = torch.zeros(sim.mj_model.nv, sim.mj_model.nv, dtype=torch.double).numpy()
    mujoco.mj_fullM(sim.mj_model, host, expected)
    torch.testing.assert_close(
        sim.mass_matrix()[1], torch.from_numpy(expected).float(), atol=1e-5, rtol=1e-4
    )
