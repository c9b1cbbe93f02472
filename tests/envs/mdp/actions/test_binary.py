"""Binary gripper action."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.envs.mdp import BinaryJointPositionActionCfg

GRIPPER_XML = """
<mujoco>
  <worldbody>
    <body name="palm">
      <geom type="box" size=".05 .02 .02"/>
      <body name="left" pos="0 .05 0">
        <joint name="left_finger" type="slide" axis="0 1 0" range="-.05 .05" damping="1"/>
        <geom type="box" size=".01 .005 .03" mass=".05"/>
      </body>
      <body name="right" pos="0 -.05 0">
        <joint name="right_finger" type="slide" axis="0 1 0" range="-.05 .05" damping="1"/>
        <geom type="box" size=".01 .005 .03" mass=".05"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
FINGERS = BuiltinPositionActuatorCfg(
    target_names_expr=(".*_finger",), stiffness=100.0, damping=3.0, effort_limit=20.0
)
OPEN = {"left_finger": 0.04, "right_finger": -0.04}
CLOSED = {".*_finger": 0.0}


def make(make_world: Any, **fields: Any) -> tuple[Any, Any]:
    world = make_world(GRIPPER_XML, num_envs=2, actuators=(FINGERS,))
    fields = {"open_command_expr": OPEN, "close_command_expr": CLOSED, **fields}
    cfg = BinaryJointPositionActionCfg(entity_name="robot", actuator_names=(".*_finger",), **fields)
    return cfg.build(world), world


def run(gripper: Any, world: Any, action: list[float]) -> torch.Tensor:
    """Return the finger positions half a second after an action."""
    gripper.process_actions(torch.tensor(action).unsqueeze(1))
    for _ in range(100):
        gripper.apply_actions()
        world.robot.write_data_to_sim()
        world.sim.step()
    return world.robot.data.joint_pos.clone()


def test_the_gripper_opens_and_closes(make_world: Any) -> None:
    gripper, world = make(make_world)
    is_open, is_closed = [0.04, -0.04], [0.0, 0.0]
    for action, expected in (
        ([1.0, -1.0], [is_open, is_closed]),
        ([-0.1, 0.0], [is_closed, is_open]),
    ):
        fingers = run(gripper, world, action)
        torch.testing.assert_close(fingers, torch.tensor(expected), atol=2e-3, rtol=0.0)
    assert gripper.action_dim == 1


def test_a_reset_opens_the_gripper(make_world: Any) -> None:
    gripper, world = make(make_world)
    run(gripper, world, [-1.0, -1.0])
    gripper.reset(torch.tensor([1]))
    gripper.apply_actions()
    target = world.robot.data.joint_pos_target
    torch.testing.assert_close(target, torch.tensor([[0.0, 0.0], [0.04, -0.04]]))
    assert gripper.raw_action.tolist() == [[-1.0], [0.0]]


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"open_command_expr": {"left_finger": 0.04}}, r"open_command_expr.*right_finger"),
        ({"close_command_expr": {"thumb": 0.0, ".*_finger": 0.0}}, r"close_command_expr.*thumb"),
    ],
)
def test_every_joint_needs_a_position(make_world: Any, fields: Any, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        make(make_world, **fields)
