"""Differential inverse kinematics: its formula, against mink, its limits, and both engines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mink
import mujoco
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.entity import EntityCfg
from mjlab.envs.mdp import DifferentialIKAction, DifferentialIKActionCfg
from mjlab.envs.mdp.actions.differential_ik import damped_least_squares
from mjlab.utils.lab_api.math import (
    compute_pose_error,
    quat_box_plus,
    quat_from_matrix,
    random_orientation,
)
from mjlab.utils.state import capture_state

# Six hinges, as those of an arm with a spherical wrist; a hand with a site off its joints' axes.
ARM_XML = """
<mujoco>
  <compiler angle="radian"/>
  <default><joint armature=".02" limited="true"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="base">
      <geom type="box" size=".05 .05 .05"/>
      <body name="l1" pos="0 0 .1">
        <joint name="j1" axis="0 0 1" range="-2.6 2.6"/><geom type="sphere" size=".03"/>
        <body name="l2" pos="0 0 .1">
          <joint name="j2" axis="0 1 0" range="0 3.6"/>
          <geom type="capsule" size=".03" fromto="0 0 0 -.26 0 0"/>
          <body name="l3" pos="-.26 0 0">
            <joint name="j3" axis="0 -1 0" range="0 3.1"/>
            <geom type="capsule" size=".03" fromto="0 0 0 .25 0 .06"/>
            <body name="l4" pos=".25 0 .06">
              <joint name="j4" axis="0 -1 0" range="-1.6 1.6"/><geom type="sphere" size=".03"/>
              <body name="l5" pos=".07 0 0">
                <joint name="j5" axis="0 0 1" range="-1.6 1.6"/><geom type="sphere" size=".03"/>
                <body name="hand" pos=".04 0 0">
                  <joint name="j6" axis="1 0 0" range="-2.1 2.1"/>
                  <geom name="palm" type="box" size=".04 .03 .02" pos=".05 .01 0" euler=".1 .2 .3"/>
                  <site name="grasp" pos=".12 0 .01" euler=".3 -.2 .5"/>
                  <site name="tip_1" pos=".14 .02 0"/><site name="tip_2" pos=".14 -.02 0"/>
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
ENGINES = ("native", "warp")
NUM_ENVS = 4
HOME = (0.2, 1.0, 1.1, -0.4, 0.3, 0.5)
MOTORS = BuiltinPositionActuatorCfg(target_names_expr=("j.*",), stiffness=100.0, damping=10.0)
LAWS = settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def make_arm(make_world: Any, num_envs: int = NUM_ENVS, engine: str = "native") -> Any:
    """Arms near their home pose, each a little different; soft limits are 0.9 of the limits."""
    state = EntityCfg.InitialStateCfg(joint_pos=dict(zip(JOINTS, HOME, strict=True)))
    world = make_world(
        ARM_XML, num_envs=num_envs, engine=engine, actuators=(MOTORS,), init_state=state
    )
    world.sim.data.qpos[:] = torch.tensor(HOME) + 0.1 * torch.randn(
        num_envs, 6, generator=torch.Generator().manual_seed(1)
    )
    world.sim.forward()
    return world


JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")


@pytest.fixture
def arm(make_world: Any) -> Any:
    return make_arm(make_world)


def term(arm: Any, actuator_names: tuple[str, ...] = (".*",), **fields: Any) -> Any:
    fields = {"frame_type": "site", "frame_name": "grasp", **fields}
    cfg = DifferentialIKActionCfg(entity_name="robot", actuator_names=actuator_names, **fields)
    return cfg.build(arm)


def act(ik: Any, action: Any) -> None:
    ik.process_actions(torch.as_tensor(action, dtype=torch.float).expand(ik.num_envs, -1))


def follow(ik: Any, arm: Any, steps: int) -> None:
    """Move the joints to their targets, again and again, as an arm without inertia would."""
    for _ in range(steps):
        ik.apply_actions()
        arm.sim.data.qpos[:] = arm.robot.data.joint_pos_target
        arm.sim.forward()


def pose(arm: Any) -> tuple[torch.Tensor, torch.Tensor]:
    site = arm.sim.mj_model.site("grasp").id
    data = arm.sim.data
    return data.site_xpos[:, site].clone(), quat_from_matrix(data.site_xmat[:, site])


def residual(ik: Any, arm: Any) -> torch.Tensor:
    return (pose(arm)[0] - ik._desired_pos).norm(dim=1)


# The action.


@pytest.mark.parametrize(
    ("fields", "size"),
    [
        ({"orientation_weight": 0.0}, 3),
        ({"orientation_weight": 0.0, "use_relative_mode": False}, 3),
        ({}, 6),
        ({"use_relative_mode": False}, 7),
    ],
)
def test_the_size_says_what_the_target_is(arm: Any, fields: Any, size: int) -> None:
    assert term(arm, **fields).action_dim == size


def test_relative_actions_move_the_target_from_the_present_pose(arm: Any) -> None:
    ik = term(arm, delta_pos_scale=0.1, delta_ori_scale=0.5)
    position, quat = pose(arm)
    act(ik, [1.0, 2.0, -1.0, 0.2, 0.0, -0.4])
    torch.testing.assert_close(ik._desired_pos, position + torch.tensor([0.1, 0.2, -0.1]))
    turn = torch.tensor([0.1, 0.0, -0.2]).expand(NUM_ENVS, -1)
    torch.testing.assert_close(ik._desired_quat, quat_box_plus(quat, turn))
    assert ik.raw_action[0].tolist() == pytest.approx([1.0, 2.0, -1.0, 0.2, 0.0, -0.4])


def test_an_absolute_orientation_is_normalized(arm: Any) -> None:
    ik = term(arm, use_relative_mode=False)
    position, _ = pose(arm)
    wanted = random_orientation(NUM_ENVS, "cpu")
    steps = []
    for length in (1.0, 1e-3, 30.0):
        ik.process_actions(torch.cat((position, length * wanted), dim=1))
        torch.testing.assert_close(ik._desired_quat, wanted)
        steps.append(ik.compute_dq())
    torch.testing.assert_close(steps[0], steps[1])
    torch.testing.assert_close(steps[0], steps[2])


def test_an_absolute_orientation_of_zeros_keeps_the_present_one(arm: Any) -> None:
    ik = term(arm, use_relative_mode=False)
    position, quat = pose(arm)
    ik.process_actions(torch.cat((position, torch.zeros(NUM_ENVS, 4)), dim=1))
    torch.testing.assert_close(ik._desired_quat, quat)
    assert ik.compute_dq().abs().max() < 1e-5


def test_reset_forgets_the_targets_of_the_given_environments(arm: Any) -> None:
    ik = term(arm)
    act(ik, [1.0] * 6)
    kept = ik._desired_pos[1].clone()
    ik.reset(torch.tensor([0, 2]))
    assert ik.raw_action[:, 0].tolist() == [0.0, 1.0, 0.0, 1.0]
    assert ik._desired_pos[0].tolist() == [0.0] * 3
    assert ik._desired_quat[2].tolist() == [1.0, 0.0, 0.0, 0.0]
    torch.testing.assert_close(ik._desired_pos[1], kept)
    ik.reset()
    assert not ik.raw_action.any()


def test_saved_state_is_the_action_and_the_target(arm: Any) -> None:
    state = capture_state(term(arm))
    assert {name for name, value in state.items() if isinstance(value, torch.Tensor)} == {
        "_raw_actions",
        "_desired_pos",
        "_desired_quat",
    }


def test_it_acts_at_every_substep(arm: Any) -> None:
    assert term(arm).needs_substep


# The Jacobian and the formula.


@pytest.mark.parametrize(("kind", "name"), [("site", "grasp"), ("geom", "palm"), ("body", "hand")])
def test_the_jacobian_is_that_of_finite_differences(arm: Any, kind: str, name: str) -> None:
    ik = term(arm, frame_type=kind, frame_name=name, damping=0.0)
    sim, step = arm.sim, 1e-2
    start = sim.data.qpos.clone()
    jacobians = sim.jacobian(ik._get_frame_pose()[0], ik._body_ids)
    for joint in range(6):
        poses = []
        for sign in (-1.0, 1.0):
            sim.data.qpos[:] = start
            sim.data.qpos[:, joint] += sign * step
            sim.forward()
            poses.append([part.clone() for part in ik._get_frame_pose()])
        shift, turn = compute_pose_error(*poses[0], *poses[1])
        for jacobian, difference in zip(jacobians, (shift, turn), strict=True):
            torch.testing.assert_close(
                jacobian[:, :, joint], difference / (2 * step), atol=3e-4, rtol=1e-3
            )


@pytest.mark.parametrize("engine", ENGINES)
def test_pose_and_jacobian_are_of_the_same_moment(make_world: Any, engine: str) -> None:
    arm = make_arm(make_world, engine=engine)
    ik = term(arm)
    before = [part.clone() for part in arm.sim.jacobian(ik._get_frame_pose()[0], ik._body_ids)]
    position = pose(arm)[0]
    arm.sim.data.qvel[:] = 3.0
    arm.sim.step(1)
    torch.testing.assert_close(pose(arm)[0], position)
    after = arm.sim.jacobian(position, ik._body_ids)
    torch.testing.assert_close(after[0], before[0], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(after[1], before[1], atol=1e-6, rtol=1e-5)


def test_both_engines_command_the_same_targets(make_world: Any) -> None:
    targets = []
    for engine in ENGINES:
        arm = make_arm(make_world, engine=engine)
        ik = term(arm, actuator_names=("j[1-5]",), joint_limit_weight=0.3, posture_weight=0.1)
        act(ik, [0.1, -0.05, 0.05, 0.3, 0.0, 0.2])
        for _ in range(4):
            ik.apply_actions()
            arm.robot.write_data_to_sim()
            arm.sim.step(1)
        targets.append(arm.robot.data.joint_pos_target.clone())
    assert (targets[0] - torch.tensor(HOME)).abs().max() > 0.05
    torch.testing.assert_close(targets[0], targets[1], atol=2e-5, rtol=1e-4)


def test_only_controlled_joints_move(arm: Any) -> None:
    ik = term(arm, actuator_names=("j5", "j2"))
    arm.robot.data.joint_pos_target[:] = 9.0
    act(ik, [0.05] * 6)
    ik.apply_actions()
    changed = (arm.robot.data.joint_pos_target != 9.0).all(dim=0)
    assert changed.tolist() == [False, True, False, False, True, False]
    assert ik.compute_dq().shape == (NUM_ENVS, 2)


# Against mink: https://github.com/kevinzakka/mink


class SeparateErrors(mink.FrameTask):
    """mink's task with errors of position and orientation apart, instead of the log of the pose."""

    def _error_and_jacobian(self, configuration: Any) -> tuple[np.ndarray, np.ndarray]:
        target = self.transform_target_to_world
        frame = configuration.get_transform_frame_to_world(self.frame_name, self.frame_type)
        shift = frame.rotation().inverse().apply(target.translation() - frame.translation())
        turn = (frame.rotation().inverse() @ target.rotation()).log()
        jacobian = -configuration.get_frame_jacobian(self.frame_name, self.frame_type)
        return np.concatenate([shift, turn]), jacobian


def mink_dq(ik: Any, arm: Any, env: int, task: type, limited: bool = False) -> torch.Tensor:
    """The step of one environment as mink computes it from the same costs."""
    model, cfg = arm.sim.mj_model, ik.cfg
    q = arm.sim.data.qpos[env].double().numpy()
    configuration = mink.Configuration(model, q)
    frame = task(
        cfg.frame_name,
        cfg.frame_type,
        position_cost=cfg.position_weight,
        orientation_cost=cfg.orientation_weight,
    )
    wanted = torch.cat((ik._desired_quat[env], ik._desired_pos[env])).double().numpy()
    frame.set_target(mink.SE3(wanted))
    low, high = arm.robot.data.soft_joint_pos_limits[env].double().numpy().T
    nearest = np.clip(q, low, high)
    outside = mink.PostureTask(model, cost=cfg.joint_limit_weight * (nearest != q))
    outside.set_target(nearest)
    posture = mink.PostureTask(model, cost=cfg.posture_weight)
    wanted_q = q.copy()
    wanted_q[ik._columns] = ik._posture[env].double().numpy()
    posture.set_target(wanted_q)
    # Joints that are not controlled stand still.
    frozen = sorted(set(range(model.nv)) - set(np.arange(model.nv)[ik._dofs].tolist()))
    limits = []
    if limited:
        own = mujoco.MjModel.from_xml_string(ARM_XML)
        own.jnt_range[:] = np.stack([low, high], axis=1)
        limits = [mink.ConfigurationLimit(own, gain=1.0)]
    velocity = mink.solve_ik(
        configuration,
        [frame, outside, posture],
        dt=1.0,
        solver="daqp",
        damping=cfg.damping**2,
        limits=limits,
        constraints=[mink.DofFreezingTask(model, frozen)] if frozen else None,
    )
    return torch.from_numpy(velocity).float()[ik._dofs]


COSTS: tuple[dict[str, float], ...] = (
    {},
    {"orientation_weight": 0.2, "position_weight": 3.0, "damping": 0.3},
    {"orientation_weight": 0.0, "damping": 0.1, "posture_weight": 0.4},
    {"position_weight": 0.0, "posture_weight": 0.05},
    {"joint_limit_weight": 0.7, "posture_weight": 0.2, "damping": 0.02},
)


@pytest.mark.parametrize("costs", COSTS)
def test_a_step_is_that_of_mink_with_the_same_costs(arm: Any, costs: dict[str, float]) -> None:
    ik = term(arm, **costs, max_dq=9.0, posture_target={"j[23]": 0.8, "j6": -0.1})
    # Joints that are outside their soft limits come back at once; mink's posture task only pulls.
    if "joint_limit_weight" in costs:
        arm.robot.data.soft_joint_pos_limits[:, 1] = torch.tensor([1.05, 9.0])
    act(ik, torch.tensor([0.08, -0.06, 0.05, 0.4, -0.3, 0.2])[: ik.action_dim])
    found = damped_least_squares(*ik._least_squares(*_to_limits(arm)))
    for env in range(NUM_ENVS):
        expected = mink_dq(ik, arm, env, SeparateErrors)
        torch.testing.assert_close(found[env], expected, atol=2e-5, rtol=2e-4)
    if "joint_limit_weight" not in costs:
        torch.testing.assert_close(ik.compute_dq(), found, atol=0.0, rtol=0.0)


def _to_limits(arm: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    q = arm.robot.data.joint_pos
    limits = arm.robot.data.soft_joint_pos_limits - q.unsqueeze(-1)
    return q, limits[..., 0], limits[..., 1]


def test_small_steps_are_those_of_minks_own_frame_task(arm: Any) -> None:
    # The logarithm of a pose couples shift and turn, which matters less the nearer the target is.
    ik = term(arm)
    differences = []
    for size in (0.2, 0.02):
        act(ik, size * torch.tensor([0.3, -0.2, 0.2, 0.5, -0.6, 0.4]))
        found = ik.compute_dq()
        expected = torch.stack([mink_dq(ik, arm, k, mink.FrameTask) for k in range(NUM_ENVS)])
        differences.append(((found - expected).norm() / expected.norm()).item())
    assert differences[0] < 0.1
    assert differences[1] < 0.12 * differences[0]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("names", [(".*",), ("joint.*",)], ids=["with the gripper", "arm"])
def test_a_step_of_the_yam_is_that_of_mink_and_its_fingers_stay_coupled(
    world_of: Any, engine: str, names: tuple[str, ...]
) -> None:
    yam = world_of(get_yam_robot_cfg(), num_envs=2, engine=engine)
    yam.sim.data.qpos[:] = yam.robot.data.default_joint_pos
    yam.sim.data.qpos[1, :6] += 0.1
    yam.robot.data.joint_pos_target[:] = yam.sim.data.qpos
    yam.sim.forward()
    # A posture with the gripper wider open than it is.
    posture = {"left_finger": 0.03} if names == (".*",) else None
    ik = term(
        yam, names, frame_name="grasp_site", posture_weight=0.1, posture_target=posture, max_dq=9.0
    )
    act(ik, [0.04, -0.03, 0.02, 0.2, -0.1, 0.1])
    found = ik.compute_dq()
    # The motor of the gripper is at the left finger; an equality moves the right one.
    assert found.shape == (2, 7 if posture else 6)
    for env in range(2):
        expected = mink_dq(ik, yam, env, SeparateErrors)
        torch.testing.assert_close(found[env], expected, atol=2e-5, rtol=1e-3)
    assert found[:, :6].abs().max() > 0.02
    left, right = (yam.robot.joint_names.index(f"{side}_finger") for side in ("left", "right"))
    before = yam.sim.data.qpos[:, left].clone()
    for _ in range(50):
        ik.apply_actions()
        yam.robot.write_data_to_sim()
        yam.sim.step(1)
    opening = yam.sim.data.qpos[:, left] - before
    assert (opening > 1e-3).all() if posture else (opening.abs() < 1e-3).all()
    torch.testing.assert_close(
        yam.sim.data.qpos[:, left], -yam.sim.data.qpos[:, right], atol=1e-3, rtol=0.0
    )


def test_joints_at_limits_are_as_in_mink(arm: Any) -> None:
    limits = arm.robot.data.soft_joint_pos_limits
    # The upper arm may hardly move, which a reach downward asks of it.
    ik = term(arm, orientation_weight=0.0, max_dq=9.0)
    act(ik, [0.05, 0.0, -0.08])
    free = ik.compute_dq()
    q = arm.robot.data.joint_pos
    joint = int(free.abs().sum(dim=0).argmax())
    limits[:, joint] = torch.stack((q[:, joint] - 0.02, q[:, joint] + 0.02), dim=-1)
    found = ik.compute_dq()
    assert (found[:, joint].abs() <= 0.02 + 1e-6).all()
    expected = torch.stack(
        [mink_dq(ik, arm, k, SeparateErrors, limited=True) for k in range(NUM_ENVS)]
    )
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-3)
    # Clamping alone gives another result.
    assert (free.clamp(found.min(), found.max()) - expected).abs().max() > 1e-2


# Limits.


def test_an_arm_at_its_limit_changes_nothing_for_the_others(arm: Any) -> None:
    ik = term(arm, orientation_weight=0.0)
    act(ik, [0.05, 0.0, -0.08])
    before = ik.compute_dq()
    q = arm.robot.data.joint_pos
    arm.robot.data.soft_joint_pos_limits[0] = torch.stack((q[0] - 1e-3, q[0] + 1e-3), dim=-1)
    after = ik.compute_dq()
    assert after[0].abs().max() < 1.1e-3
    torch.testing.assert_close(after[1:], before[1:], atol=1e-7, rtol=1e-6)


def test_a_step_is_clamped_joint_by_joint(arm: Any) -> None:
    far, near = term(arm, max_dq=9.0), term(arm, max_dq=0.05)
    for ik in (far, near):
        act(ik, [0.2, 0.1, -0.1, 0.5, 0.5, 0.5])
    assert far.compute_dq().abs().max() > 0.1
    torch.testing.assert_close(near.compute_dq(), far.compute_dq().clamp(-0.05, 0.05))


def test_joints_outside_their_soft_limits_come_back_by_at_most_max_dq(arm: Any) -> None:
    arm.sim.data.qpos[:, 4] = torch.tensor([1.5, 1.55, -1.5, 3.0])
    arm.sim.forward()
    ik = term(arm, max_dq=0.1, orientation_weight=0.0)
    act(ik, [0.0, 0.0, 0.0])
    ik.apply_actions()
    high = 0.9 * 1.6
    expected = torch.tensor([high, 1.55 - 0.1, -high, 2.9])
    torch.testing.assert_close(arm.robot.data.joint_pos_target[:, 4], expected)


def test_the_limit_weight_pulls_back_what_is_outside(arm: Any) -> None:
    limits = arm.robot.data.soft_joint_pos_limits
    limits[:, 0] = torch.tensor([-2.0, 0.0])
    q = arm.robot.data.joint_pos
    arm.sim.data.qpos[:, 0] = 0.2
    arm.sim.forward()
    act(ik := term(arm, joint_limit_weight=50.0, max_dq=9.0), [0.0] * 6)
    found = ik.compute_dq()
    torch.testing.assert_close(found[:, 0], -q[:, 0], atol=1e-3, rtol=0.0)
    # The other joints keep the hand in place as well as possible.
    assert found[:, 1:].abs().max() > 0.01


@LAWS
@given(
    direction=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda d: max(map(abs, d)) > 0.1),
    distance=st.sampled_from([0.05, 1.0, 1e3, 1e18]),
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    weights=st.sampled_from(COSTS),
    damping=st.sampled_from([0.0, 1e-4, 0.05]),
)
def test_whatever_the_target_joints_stay_finite_and_within_soft_limits(
    world_factory: Any,
    direction: Any,
    distance: float,
    turn: Any,
    weights: dict[str, float],
    damping: float,
) -> None:
    arm = _shared_arm(world_factory)
    arm.sim.data.qpos[:] = torch.tensor(HOME)
    # One arm stretched out, where its Jacobian is singular.
    arm.sim.data.qpos[0, 1:] = torch.tensor([1.7, 0.3, 0.0, 0.0, 0.0])
    arm.sim.forward()
    ik = term(arm, **{**weights, "damping": damping})
    act(ik, torch.cat((distance * torch.tensor(direction), torch.tensor(turn)))[: ik.action_dim])
    low, high = arm.robot.data.soft_joint_pos_limits.unbind(-1)
    for _ in range(12):
        follow(ik, arm, 1)
        q = arm.sim.data.qpos
        assert torch.isfinite(q).all()
        assert ((q >= low - 1e-6) & (q <= high + 1e-6)).all()


_ARMS: list[Any] = []


def _shared_arm(factory: Callable[..., Any]) -> Any:
    if not _ARMS:
        _ARMS.append(make_arm(factory))
    return _ARMS[0]


@pytest.mark.parametrize("fields", [{}, {"use_relative_mode": False}, {"delta_pos_scale": 1e3}])
@pytest.mark.parametrize("size", [1e20, 3e38])
def test_the_largest_numbers_overflow_nothing(arm: Any, fields: Any, size: float) -> None:
    ik = term(arm, **fields)
    act(ik, [size] * ik.action_dim)
    dq = ik.compute_dq()
    assert torch.isfinite(dq).all()
    assert dq.abs().max() <= 0.5


@pytest.mark.parametrize("engine", ENGINES)
def test_an_unreachable_target_is_approached_in_the_simulation(
    make_world: Any, engine: str
) -> None:
    arm = make_arm(make_world, num_envs=8, engine=engine)
    ik = term(arm, orientation_weight=0.0, use_relative_mode=False)
    targets = 3.0 * torch.nn.functional.normalize(torch.randn(8, 3), dim=1)
    ik.process_actions(targets)
    start = residual(ik, arm)
    hard = arm.robot.data.joint_pos_limits
    for _ in range(300):
        ik.apply_actions()
        arm.robot.write_data_to_sim()
        arm.sim.step(1)
        q = arm.sim.data.qpos
        assert torch.isfinite(q).all()
        assert ((q > hard[..., 0]) & (q < hard[..., 1])).all()
    arm.sim.forward()
    assert (residual(ik, arm) < start - 0.05).all()


# Use cases.


@pytest.mark.parametrize(
    "fields",
    [{"orientation_weight": 0.0}, {}, {"posture_weight": 0.01, "orientation_weight": 0.0}],
)
def test_a_reach_of_ten_centimetres_ends_within_two_millimetres(
    make_world: Any, fields: dict[str, float]
) -> None:
    arm = make_arm(make_world, num_envs=128)
    ik = term(arm, **fields)
    shift = torch.nn.functional.normalize(torch.randn(128, 3), dim=1)
    ik.process_actions(torch.cat((0.1 * shift, torch.zeros(128, 3)), dim=1)[:, : ik.action_dim])
    assert residual(ik, arm).min() > 0.099
    _, quat = pose(arm)
    follow(ik, arm, 100)
    assert residual(ik, arm).max() < 2e-3
    if ik.action_dim == 6:
        error = compute_pose_error(*pose(arm), pose(arm)[0], quat)[1].norm(dim=1)
        assert error.max() < 0.02


def test_the_posture_follows_the_default(arm: Any) -> None:
    ik = term(
        arm,
        position_weight=0.0,
        orientation_weight=1e-3,
        posture_weight=9.0,
        max_dq=9.0,
        posture_target={"j2": 0.9},
    )
    arm.robot.data.default_joint_pos[:] = torch.tensor([0.1, 0.5, 0.6, 0.2, -0.1, 0.0])
    ik.process_actions(torch.zeros(NUM_ENVS, 6))
    q = arm.robot.data.joint_pos + ik.compute_dq()
    expected = torch.tensor([0.1, 0.9, 0.6, 0.2, -0.1, 0.0]).expand(NUM_ENVS, 6)
    torch.testing.assert_close(q, expected, atol=1e-3, rtol=0.0)


def test_the_posture_decides_what_the_position_leaves_open(arm: Any) -> None:
    elbows = []
    for wrist in (-0.8, 0.8):
        arm.sim.data.qpos[:] = torch.tensor(HOME)
        arm.sim.forward()
        ik = term(arm, orientation_weight=0.0, posture_weight=0.03, posture_target={"j4": wrist})
        assert ik._posture[0].tolist() == pytest.approx([0.2, 1.0, 1.1, wrist, 0.3, 0.5])
        act(ik, [0.0, 0.0, 0.0])
        follow(ik, arm, 60)
        assert residual(ik, arm).max() < 2e-3
        elbows.append(arm.sim.data.qpos[0, 3].item())
    assert elbows[0] < -0.6
    assert elbows[1] > -0.2


# Errors.


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("frame_type", "camera", "frame_type.*'camera'"),
        ("frame_name", "elbow", "elbow"),
        ("actuator_names", ("finger",), "finger"),
    ],
)
def test_bad_configs_are_refused(arm: Any, field: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        term(arm, **{field: value})


@pytest.mark.parametrize(
    ("fields", "same"),
    [
        ({"damping": -0.1}, {"damping": 0.0}),
        ({"posture_weight": -0.5}, {"posture_weight": 0.5}),
        ({"position_weight": -1.0}, {}),
        ({"frame_name": "tip_.*"}, {"frame_name": "tip_1"}),
        ({"max_dq": 0.0}, None),
        ({"position_weight": 0.0, "orientation_weight": 0.0}, None),
    ],
)
def test_odd_numbers_warn_and_act_as_squared(arm: Any, fields: Any, same: Any) -> None:
    with pytest.warns(UserWarning, match=next(iter(fields))):
        ik = term(arm, **fields)
    act(ik, torch.full((ik.action_dim,), 0.1))
    expected = torch.zeros(NUM_ENVS, 6)
    if same is not None:
        plain = term(arm, **same)
        act(plain, torch.full((plain.action_dim,), 0.1))
        expected = plain.compute_dq()
    torch.testing.assert_close(ik.compute_dq(), expected)


def test_what_has_no_effect_is_said(arm: Any, caplog: Any) -> None:
    term(arm, clip={".*": (-1.0, 1.0)})
    assert "clip has no effect" in caplog.text
    term(arm, posture_target={"wrist": 1.0})
    assert "'wrist'" in caplog.text


def test_the_scale_of_earlier_releases_scales_both_parts() -> None:
    older: Any = {"scale": 0.5, "delta_pos_scale": 0.1}
    with pytest.warns(FutureWarning, match="delta_pos_scale and delta_ori_scale"):
        cfg = DifferentialIKActionCfg(
            entity_name="robot", actuator_names=(".*",), frame_name="hand", **older
        )
    assert (cfg.delta_pos_scale, cfg.delta_ori_scale) == (0.05, 0.5)


@pytest.mark.filterwarnings("ignore:.*older:FutureWarning")
def test_joint_ids_are_those_of_the_entity(arm: Any) -> None:
    assert term(arm, ("j2", "j5"))._joint_ids.tolist() == [1, 4]
    assert term(arm)._joint_ids.tolist() == list(range(6))


def test_a_subclass_may_say_where_the_frame_is(arm: Any) -> None:
    class Tool(DifferentialIKAction):
        def _get_frame_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
            position, quat = super()._get_frame_pose()
            return position + torch.tensor([0.0, 0.0, 0.1]), quat

    cfg = DifferentialIKActionCfg(
        entity_name="robot", actuator_names=(".*",), frame_type="site", frame_name="grasp"
    )
    plain, tool = DifferentialIKAction(cfg, arm), Tool(cfg, arm)
    for ik in (plain, tool):
        act(ik, torch.zeros(6))
    torch.testing.assert_close(
        tool._desired_pos - plain._desired_pos, torch.tensor([[0.0, 0.0, 0.1]]).expand(NUM_ENVS, 3)
    )
    # For a displaced target, the error is that of the tool's point.
    plain._desired_pos.copy_(tool._desired_pos)
    assert not tool.compute_dq().abs().gt(1e-3).any()
    assert plain.compute_dq().abs().gt(1e-3).any()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_bad_action_stays_in_its_environment(arm: Any, bad: float) -> None:
    ik = term(arm)
    action = torch.zeros(NUM_ENVS, ik.action_dim)
    action[0, 0] = bad
    ik.process_actions(action)
    ik.apply_actions()
    assert arm.robot.data.joint_pos_target[1:].isfinite().all()
