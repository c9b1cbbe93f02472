"""Unitree Go1: parameters equal the tables, the robot stands, and drawing changes nothing."""

from __future__ import annotations

import mujoco
import pytest
import torch
from robot_figures import load_table
from robot_scenes import (
    check_drawing_changes_nothing,
    check_light,
    compiled,
    place,
    scene_of,
    turn_on_its_side,
)

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.asset_zoo.robots.unitree_go1 import go1_constants as go1
from mjlab.sim import MujocoCfg

TABLE = load_table("unitree_go1")
FEET = [f"{leg}_foot_collision" for leg in ("FR", "FL", "RR", "RL")]
# The settings of the velocity tasks.
MUJOCO = MujocoCfg(timestep=0.005, impratio=10, cone="elliptic", iterations=10, ls_iterations=20)


def built(**changes) -> mujoco.MjModel:
    return compiled(get_go1_robot_cfg(), **changes)


def test_the_light_and_the_cameras_follow_the_center_of_mass():
    model = go1.get_spec().compile()
    assert model.cam_mode.tolist() == [mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM] * 4
    check_light(model)


# The config, with the numbers of the task tables.


def test_motors_and_gains_are_those_of_the_task_tables():
    hip, knee = get_go1_robot_cfg().articulation.actuators
    found = {
        cfg.target_names_expr: (cfg.armature, cfg.stiffness, cfg.damping, cfg.effort_limit)
        for cfg in (hip, knee)
    }
    assert found == {
        (".*_hip_joint", ".*_thigh_joint"): pytest.approx(
            (0.004026312, 15.89524265, 1.011922576, 23.7), rel=1e-9
        ),
        (".*_calf_joint",): pytest.approx((0.009059202, 35.76429597, 2.276825796, 35.55), rel=1e-9),
    }
    assert go1.HIP_ACTUATOR.velocity_limit == 30.1
    assert go1.KNEE_ACTUATOR.velocity_limit == 20.06
    assert get_go1_robot_cfg().articulation.soft_joint_pos_limit_factor == 0.9


def test_the_compiled_joints_have_these_gains():
    model = built()
    for index in range(model.nu):
        joint = model.joint(model.actuator(index).trnid[0])
        knee = "calf" in joint.name
        stiffness, damping, armature, effort = (
            (35.76429597, 2.276825796, 0.009059202, 35.55)
            if knee
            else (15.89524265, 1.011922576, 0.004026312, 23.7)
        )
        assert model.actuator_gainprm[index, 0] == pytest.approx(stiffness)
        assert model.actuator_biasprm[index, :3] == pytest.approx([0, -stiffness, -damping])
        assert model.actuator_forcerange[index] == pytest.approx([-effort, effort])
        assert model.dof_armature[joint.dofadr[0]] == pytest.approx(armature)
    assert model.nu == 12


def test_the_action_scale_is_that_of_the_task_tables():
    scale = dict(go1.GO1_ACTION_SCALE)
    assert scale.pop(".*_calf_joint") == pytest.approx(0.2485020258)
    assert set(scale) == {".*_hip_joint", ".*_thigh_joint"}
    assert list(scale.values()) == pytest.approx([0.3727530387] * 2)


def test_the_home_pose_is_that_of_the_task_tables():
    model = built()
    qpos = model.key_qpos[0]
    assert qpos[:7] == pytest.approx([0, 0, 0.278, 1, 0, 0, 0])
    right, left = [0.1, 0.9, -1.8], [-0.1, 0.9, -1.8]
    assert qpos[7:] == pytest.approx([*right, *left, *right, *left])
    assert not model.key_qvel.any()


def test_full_collisions_are_those_of_the_task_tables():
    model = built()
    for index in range(model.ngeom):
        geom = model.geom(index)
        felt, foot = "_collision" in geom.name, geom.name in FEET
        assert (geom.contype[0], geom.conaffinity[0]) == ((1, 1) if felt else (0, 0))
        assert geom.condim[0] == (6 if foot else 1 if felt else 3)
        assert geom.priority[0] == (1 if foot else 0)
        assert geom.friction == pytest.approx([1, 0.005, 0.0005] if foot else [1, 0.005, 0.0001])
        assert geom.solref == pytest.approx([0.01, 1] if felt else [0.02, 1])
        assert geom.solimp == pytest.approx([0.9, 0.95, 0.001, 0.5, 2])


def test_feet_only_collisions_leave_nothing_but_the_feet():
    model = built(collisions=(go1.FEET_ONLY_COLLISION,))
    for index in range(model.ngeom):
        geom = model.geom(index)
        foot = geom.name in FEET
        assert (geom.contype[0], geom.conaffinity[0]) == ((0, 1) if foot else (0, 0))
        if foot:
            assert (geom.condim[0], geom.priority[0], geom.friction[0]) == (3, 1, 0.6)
            assert geom.solimp == pytest.approx([0.9, 0.95, 0.023, 0.5, 2])


# In the simulation.


def test_it_stands_for_two_seconds_at_its_home_pose():
    scene, sim = scene_of(get_go1_robot_cfg(), MUJOCO, num_envs=2)
    # At heights used by resets of the velocity tasks.
    robot = place(scene, lift=torch.tensor([0.01, 0.05]))
    for step in range(400):
        sim.step()
        if step >= 100:
            height = robot.data.root_link_pos_w[:, 2]
            assert torch.all((height - 0.278).abs() < 0.035)
    sim.forward()
    assert torch.all(robot.data.projected_gravity_b[:, 2] < -0.99)
    assert robot.data.root_link_lin_vel_w.norm(dim=-1).max() < 0.05


def test_its_sensors_work_inside_a_scene():
    _, sim = scene_of(get_go1_robot_cfg(), MUJOCO)
    model = sim.mj_model
    assert [model.sensor(i).name for i in range(model.nsensor)] == [
        f"robot/{sensor['name']}" for sensor in TABLE["sensors"]
    ]
    turn_on_its_side(sim)
    sim.forward()
    address = model.sensor("robot/imu_upvector").adr[0]
    up = sim.data.sensordata[0, address : address + 3]
    torch.testing.assert_close(up, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


def test_what_is_drawn_changes_neither_masses_nor_contacts():
    on_its_side = dict(enumerate([0.5**0.5, 0.5**0.5, 0, 0], start=3))
    check_drawing_changes_nothing(get_go1_robot_cfg(), MUJOCO, on_its_side, at_least=31)
