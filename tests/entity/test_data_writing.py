"""State and target writers: written values are read back, and nothing else changes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import BuiltinMotorActuatorCfg, BuiltinPositionActuatorCfg, TransmissionType
from mjlab.entity import EntityArticulationInfoCfg

NUM_ENVS = 4
ENV_IDS = {
    "all": None,
    "slice": slice(1, 3),
    "mask": torch.tensor([True, False, True, False]),
    "indices": torch.tensor([3, 0]),
    "int32": torch.tensor([2, 1], dtype=torch.int32),
    "none of them": torch.tensor([], dtype=torch.int64),
}


@pytest.fixture(params=ENV_IDS, ids=str)
def env_ids(request):
    return ENV_IDS[request.param]


def chosen(env_ids):
    """The environments that `env_ids` means, in order."""
    return torch.arange(NUM_ENVS) if env_ids is None else torch.arange(NUM_ENVS)[env_ids]


def others(env_ids):
    mask = torch.ones(NUM_ENVS, dtype=torch.bool)
    mask[chosen(env_ids)] = False
    return mask


def unit_quaternions(count):
    return torch.nn.functional.normalize(torch.randn(count, 4), dim=-1)


@pytest.fixture
def floating(kit):
    torch.manual_seed(0)
    sim, scene = kit.make(NUM_ENVS, other=kit.cfg(kit.ARM), robot=kit.cfg(kit.ROBOT))
    kit.randomize(sim)
    return sim, scene["robot"]


def test_root_state_round_trip(floating, env_ids):
    sim, robot = floating
    rows = chosen(env_ids)
    before = sim.data.qpos.clone(), sim.data.qvel.clone()
    state = torch.randn(len(rows), 13)
    state[:, 3:7] = unit_quaternions(len(rows))
    robot.write_root_state_to_sim(state, env_ids)
    sim.forward()
    torch.testing.assert_close(robot.data.root_link_pose_w[rows], state[:, :7], rtol=0, atol=1e-5)
    torch.testing.assert_close(robot.data.root_link_vel_w[rows], state[:, 7:], rtol=0, atol=1e-4)
    assert torch.equal(sim.data.qpos[others(env_ids)], before[0][others(env_ids)])
    assert torch.equal(sim.data.qvel[others(env_ids)], before[1][others(env_ids)])
    # Of the chosen environments, only the root's own entries changed.
    joints = robot.indexing.joint_q_adr.long()
    assert torch.equal(sim.data.qpos[:, joints], before[0][:, joints])
    assert torch.equal(sim.data.qpos[:, :2], before[0][:, :2])


def test_root_velocity_in_body_frame_round_trip(floating, env_ids):
    sim, robot = floating
    rows = chosen(env_ids)
    velocity = torch.randn(len(rows), 6)
    robot.write_root_link_velocity_b_to_sim(velocity, env_ids)
    sim.forward()
    torch.testing.assert_close(
        robot.data.root_link_lin_vel_b[rows], velocity[:, :3], rtol=0, atol=1e-4
    )
    torch.testing.assert_close(
        robot.data.root_link_ang_vel_b[rows], velocity[:, 3:], rtol=0, atol=1e-4
    )


def test_root_com_velocity_round_trip(floating, env_ids):
    sim, robot = floating
    rows = chosen(env_ids)
    velocity = torch.randn(len(rows), 6)
    robot.write_root_com_velocity_to_sim(velocity, env_ids)
    sim.forward()
    torch.testing.assert_close(robot.data.root_com_vel_w[rows], velocity, rtol=0, atol=1e-4)
    # The two differ, or the test would not see an offset that is left out.
    assert not len(rows) or not torch.allclose(
        robot.data.root_link_lin_vel_w[rows], velocity[:, :3], atol=1e-3
    )


def test_derived_fields_wait_for_forward(floating):
    sim, robot = floating
    before = robot.data.root_link_pos_w.clone()
    pose = torch.tensor([[9.0, 9.0, 9.0, 1.0, 0.0, 0.0, 0.0]]).repeat(NUM_ENVS, 1)
    robot.write_root_link_pose_to_sim(pose)
    assert torch.equal(robot.data.root_link_pos_w, before)
    sim.forward()
    assert torch.equal(robot.data.root_link_pos_w, pose[:, :3])


@pytest.mark.parametrize(
    "joint_ids", [None, slice(1, 3), [2, 0], torch.tensor([2, 0]), slice(0, 3, 2), [1]], ids=str
)
def test_joint_state_and_targets_take_all_forms_of_ids(kit, env_ids, joint_ids):
    """Tensors of environments and of joints select their product."""
    chain = """<mujoco><worldbody><body><geom size=".1"/><joint name="a"/>
      <body><geom size=".1"/><joint name="b"/><body><geom size=".1"/><joint name="c"/>
      </body></body></body></worldbody></mujoco>"""
    torch.manual_seed(0)
    sim, scene = kit.make(NUM_ENVS, other=kit.cfg(kit.ROBOT), chain=kit.cfg(chain))
    chain = scene["chain"]
    columns = torch.arange(3) if joint_ids is None else torch.arange(3)[joint_ids]
    rows = chosen(env_ids)
    position = torch.randn(len(rows), len(columns))
    velocity = torch.randn(len(rows), len(columns))
    chain.write_joint_state_to_sim(position, velocity, joint_ids, env_ids)
    chain.set_joint_position_target(position, joint_ids, env_ids)
    chain.set_joint_velocity_target(velocity, joint_ids, env_ids)
    chain.set_joint_effort_target(position + 1.0, joint_ids, env_ids)
    for actual, written in (
        (chain.data.joint_pos, position),
        (chain.data.joint_vel, velocity),
        (chain.data.joint_pos_target, position),
        (chain.data.joint_vel_target, velocity),
        (chain.data.joint_effort_target, position + 1.0),
    ):
        expected = torch.zeros(NUM_ENVS, 3)
        expected[rows[:, None], columns] = written
        torch.testing.assert_close(actual.clone(), expected, rtol=0, atol=0)


def test_mocap_pose_takes_all_forms_of_env_ids(kit, env_ids):
    """The reference raises a shape error for None and slices."""
    torch.manual_seed(0)
    sim, scene = kit.make(NUM_ENVS, other=kit.cfg(kit.ARM), arm=kit.cfg(kit.ARM))
    arm, rows = scene["arm"], chosen(env_ids)
    before = sim.data.mocap_pos.clone()
    pose = torch.cat((torch.randn(len(rows), 3), unit_quaternions(len(rows))), dim=-1)
    arm.write_mocap_pose_to_sim(pose, env_ids)
    sim.forward()
    torch.testing.assert_close(arm.data.root_link_pose_w[rows], pose, rtol=0, atol=1e-6)
    assert torch.equal(sim.data.mocap_pos[others(env_ids)], before[others(env_ids)])
    assert torch.equal(sim.data.mocap_pos[:, 0], before[:, 0]), "the other entity moved"


@pytest.mark.parametrize("body_ids", [None, [2, 0], slice(0, 2), torch.tensor([1])], ids=str)
def test_external_wrench_reaches_bodies_and_persists(floating, env_ids, body_ids):
    sim, robot = floating
    sim.data.xfrc_applied.zero_()
    columns = torch.arange(3) if body_ids is None else torch.arange(3)[body_ids]
    rows = chosen(env_ids)
    force, torque = torch.randn(2, len(rows), len(columns), 3)
    robot.write_external_wrench_to_sim(force, torque, env_ids, body_ids)
    sim.step()
    expected = torch.zeros(NUM_ENVS, 3, 6)
    expected[rows[:, None], columns] = torch.cat((force, torque), dim=-1)
    torch.testing.assert_close(robot.data.body_external_wrench.clone(), expected)
    robot.data.write_external_wrench(None, torch.zeros_like(torque), body_ids, env_ids)
    torch.testing.assert_close(robot.data.body_external_force.clone(), expected[..., :3])
    assert not robot.data.body_external_torque.any()


def test_ctrl_ids_count_within_the_entity(kit, env_ids):
    motor = EntityArticulationInfoCfg(
        actuators=(BuiltinMotorActuatorCfg(target_names_expr=("hip", "knee"), effort_limit=5.0),)
    )
    _, scene = kit.make(
        NUM_ENVS,
        other=kit.cfg(kit.ROBOT, articulation=motor),
        robot=kit.cfg(kit.ROBOT, articulation=motor),
    )
    rows = chosen(env_ids)
    scene["robot"].write_ctrl_to_sim(torch.full((len(rows), 1), 2.0), [1], env_ids)
    expected = torch.zeros(NUM_ENVS, 4)
    expected[rows, 3] = 2.0
    assert torch.equal(scene["robot"].data.data.ctrl, expected)


def test_writing_what_the_entity_does_not_have_is_refused(kit):
    ball = '<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    _, scene = kit.make(2, arm=kit.cfg(kit.ARM), ball=kit.cfg(ball))
    arm, ball = scene["arm"], scene["ball"]
    with pytest.raises(ValueError, match="fixed base.*write_mocap_pose"):
        arm.write_root_state_to_sim(torch.zeros(2, 13))
    with pytest.raises(ValueError, match="no mocap root.*write_root_pose"):
        ball.write_mocap_pose_to_sim(torch.zeros(2, 7))
    with pytest.raises(ValueError, match="no joints"):
        ball.write_joint_position_to_sim(torch.zeros(2, 0))
    with pytest.raises(ValueError, match="no configured actuators.*EntityCfg.articulation"):
        arm.write_ctrl_to_sim(torch.zeros(2, 1))
    with pytest.raises(ValueError, match="no joint targets"):
        ball.set_joint_position_target(torch.zeros(2, 1))
    with pytest.raises(ValueError, match="no configured actuator acts on a tendon"):
        arm.set_tendon_len_target(torch.zeros(2, 1))


@pytest.mark.parametrize(
    ("writer", "width", "given"),
    [
        ("write_root_state_to_sim", 13, 7),
        ("write_root_link_pose_to_sim", 7, 6),
        ("write_root_link_velocity_to_sim", 6, 3),
        ("write_root_link_velocity_b_to_sim", 6, 1),
        ("write_root_com_velocity_to_sim", 6, 7),
        ("write_joint_position_to_sim", 2, 4),
        ("write_joint_velocity_to_sim", 2, 3),
        ("set_joint_position_target", 2, 3),
    ],
)
def test_a_wrong_width_is_reported_with_both_numbers(floating, writer, width, given):
    _, robot = floating
    with pytest.raises(ValueError, match=rf"{width}\), got {given} values"):
        getattr(robot, writer)(torch.zeros(NUM_ENVS, given))


def test_one_value_per_environment_counts_for_all_joints(floating, env_ids):
    sim, robot = floating
    rows = chosen(env_ids)
    before = sim.data.qpos.clone()
    value = torch.randn(len(rows), 1)
    robot.write_joint_state_to_sim(value, 2 * value, env_ids=env_ids)
    torch.testing.assert_close(robot.data.joint_pos[rows], value.expand(-1, 2))
    torch.testing.assert_close(robot.data.joint_vel[rows], 2 * value.expand(-1, 2))
    robot.write_joint_position_to_sim(3 * value, joint_ids=[1, 0], env_ids=env_ids)
    robot.write_joint_velocity_to_sim(4 * value, joint_ids=torch.tensor([0]), env_ids=env_ids)
    torch.testing.assert_close(robot.data.joint_pos[rows], 3 * value.expand(-1, 2))
    torch.testing.assert_close(robot.data.joint_vel[rows], torch.cat((4 * value, 2 * value), 1))
    for kind in ("position", "velocity", "effort"):
        getattr(robot, f"set_joint_{kind}_target")(value, env_ids=env_ids)
    for target in ("joint_pos_target", "joint_vel_target", "joint_effort_target"):
        torch.testing.assert_close(getattr(robot.data, target)[rows], value.expand(-1, 2))
    assert torch.equal(sim.data.qpos[others(env_ids)], before[others(env_ids)])


def test_reset_zeroes_targets_of_these_environments_and_keeps_the_bias(kit, env_ids):
    cable = BuiltinMotorActuatorCfg(
        target_names_expr=("cable",), transmission_type=TransmissionType.TENDON, effort_limit=1.0
    )
    push = BuiltinMotorActuatorCfg(
        target_names_expr=("tip",), transmission_type=TransmissionType.SITE, effort_limit=1.0
    )
    articulation = EntityArticulationInfoCfg(actuators=(cable, push))
    _, scene = kit.make(NUM_ENVS, arm=kit.cfg(kit.ARM, articulation=articulation))
    data = scene["arm"].data
    targets = (
        data.joint_pos_target,
        data.joint_vel_target,
        data.joint_effort_target,
        data.tendon_len_target,
        data.tendon_vel_target,
        data.tendon_effort_target,
        data.site_effort_target,
    )
    assert [t.shape[1] for t in targets] == [2, 2, 2, 1, 1, 1, 1]
    for target in (*targets, data.encoder_bias):
        target.fill_(0.5)
    scene["arm"].reset(env_ids)
    for target in targets:
        assert not target[chosen(env_ids)].any()
        assert (target[others(env_ids)] == 0.5).all()
    assert (data.encoder_bias == 0.5).all()


def test_position_targets_are_seeded_where_none_was_set(kit, env_ids):
    sim, scene = kit.make(NUM_ENVS, robot=kit.cfg(kit.ROBOT))
    robot = scene["robot"]
    robot.write_joint_position_to_sim(torch.tensor([[0.3, -0.4]]).repeat(NUM_ENVS, 1))
    robot.set_joint_position_target(torch.full((NUM_ENVS, 1), 0.1), [1])
    robot.seed_position_targets(env_ids)
    expected = torch.tensor([[0.0, 0.1]]).repeat(NUM_ENVS, 1)
    expected[chosen(env_ids), 0] = 0.3
    torch.testing.assert_close(robot.data.joint_pos_target, expected)


def test_controls_are_written_for_the_reset_environments_only(kit, env_ids):
    position = BuiltinPositionActuatorCfg(
        target_names_expr=("hip",), stiffness=1.0, damping=0.0, delay_min_lag=2, delay_max_lag=2
    )
    motor = BuiltinMotorActuatorCfg(target_names_expr=("knee",), effort_limit=9.0)
    articulation = EntityArticulationInfoCfg(actuators=(position, motor))
    sim, scene = kit.make(NUM_ENVS, robot=kit.cfg(kit.ROBOT, articulation=articulation))
    robot = scene["robot"]
    sim.data.ctrl.fill_(-7.0)
    robot.reset(env_ids)
    robot.set_joint_position_target(torch.ones(NUM_ENVS, 2))
    robot.set_joint_effort_target(torch.full((NUM_ENVS, 2), 2.0))
    robot.write_data_to_sim(chosen(env_ids))
    expected = torch.full((NUM_ENVS, 2), -7.0)
    expected[chosen(env_ids)] = torch.tensor([1.0, 2.0])
    torch.testing.assert_close(sim.data.ctrl.clone(), expected)


def test_a_step_with_a_native_position_actuator_agrees_with_mujoco(kit):
    position = BuiltinPositionActuatorCfg(
        target_names_expr=("hip", "knee"), stiffness=20.0, damping=1.0
    )
    articulation = EntityArticulationInfoCfg(actuators=(position,))
    sim, scene = kit.make(2, robot=kit.cfg(kit.ROBOT, articulation=articulation))
    robot = scene["robot"]
    robot.set_joint_position_target(torch.tensor([[0.5, -0.5], [0.1, 0.2]]))
    # The engine computes a field on first access; from then on `step` updates it.
    _ = robot.data.actuator_force
    for _ in range(20):
        scene.write_data_to_sim()
        sim.step()
        scene.update(0.002)
    for env, target in enumerate(([0.5, -0.5], [0.1, 0.2])):
        data = mujoco.MjData(sim.mj_model)
        data.ctrl[:] = target
        for _ in range(20):
            mujoco.mj_step(sim.mj_model, data)
        np.testing.assert_allclose(sim.data.qpos[env].numpy(), data.qpos, atol=1e-5)
        # The force belongs to the state before the last integration, on both.
        np.testing.assert_allclose(
            robot.data.actuator_force[env].numpy(), data.actuator_force, atol=1e-3
        )
