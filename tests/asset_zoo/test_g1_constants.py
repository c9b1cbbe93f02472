"""Unitree G1: parameters equal the tables, the robot stands, and drawing changes nothing."""

from __future__ import annotations

import re

import mujoco
import numpy as np
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

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.asset_zoo.robots.unitree_g1 import g1_constants as g1
from mjlab.sim import MujocoCfg

TABLE = load_table("unitree_g1")
FEET = [f"{side}_foot{i}_collision" for side in ("left", "right") for i in range(1, 8)]
KEYFRAMES = {"home": g1.HOME_KEYFRAME, "knees_bent": g1.KNEES_BENT_KEYFRAME}
# The settings of the velocity tasks.
MUJOCO = MujocoCfg(timestep=0.005, iterations=10, ls_iterations=20)

# The actuators of the task tables, in order: joints, then armature, stiffness, damping and effort
# limit, and the action scale.
SHOULDER, HIP, KNEE = "5020", "7520-14", "7520-22"
WRIST, WAIST, ANKLE = "4010", "waist", "ankle"
GAINS = {
    SHOULDER: (0.003609725, 14.2506231, 0.9072228433, 25.0),
    HIP: (0.01017752004, 40.17923863, 2.557889775, 88.0),
    KNEE: (0.025101925, 99.09842778, 6.308801853, 139.0),
    WRIST: (0.00425, 16.77832748, 1.068141502, 5.0),
    WAIST: (0.00721945, 28.5012462, 1.814445687, 50.0),
    ANKLE: (0.00721945, 28.5012462, 1.814445687, 50.0),
}
MOTORS = {
    ".*_elbow_joint": SHOULDER,
    ".*_shoulder_pitch_joint": SHOULDER,
    ".*_shoulder_roll_joint": SHOULDER,
    ".*_shoulder_yaw_joint": SHOULDER,
    ".*_wrist_roll_joint": SHOULDER,
    ".*_hip_pitch_joint": HIP,
    ".*_hip_yaw_joint": HIP,
    "waist_yaw_joint": HIP,
    ".*_hip_roll_joint": KNEE,
    ".*_knee_joint": KNEE,
    ".*_wrist_pitch_joint": WRIST,
    ".*_wrist_yaw_joint": WRIST,
    "waist_pitch_joint": WAIST,
    "waist_roll_joint": WAIST,
    ".*_ankle_pitch_joint": ANKLE,
    ".*_ankle_roll_joint": ANKLE,
}
ACTION_SCALES = {
    SHOULDER: 0.4385773139,
    HIP: 0.547546463,
    KNEE: 0.3506614664,
    WRIST: 0.07450087033,
    WAIST: 0.4385773139,
    ANKLE: 0.4385773139,
}


def built(**changes) -> mujoco.MjModel:
    return compiled(get_g1_robot_cfg(), **changes)


def motor_of(joint: str) -> str:
    (motor,) = {motor for pattern, motor in MOTORS.items() if re.fullmatch(pattern, joint)}
    return motor


def test_the_light_and_the_camera_follow_the_center_of_mass():
    model = g1.get_spec().compile()
    assert model.cam_mode.tolist() == [mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM]
    assert not model.light(0).castshadow[0]
    check_light(model)


# The config, with the numbers of the task tables.


def test_motors_and_gains_are_those_of_the_task_tables():
    actuators = get_g1_robot_cfg().articulation.actuators
    assert [pattern for cfg in actuators for pattern in cfg.target_names_expr] == list(MOTORS)
    assert len(actuators) == len(GAINS)
    for cfg in actuators:
        (motor,) = {MOTORS[pattern] for pattern in cfg.target_names_expr}
        found = (cfg.armature, cfg.stiffness, cfg.damping, cfg.effort_limit)
        assert found == pytest.approx(GAINS[motor], rel=1e-9), motor
    assert get_g1_robot_cfg().articulation.soft_joint_pos_limit_factor == 0.9


def test_gains_give_frequency_and_damping_ratio():
    for motor in ("5020", "7520_14", "7520_22", "4010"):
        inertia, stiffness, damping = (
            getattr(g1, f"{figure}_{motor}") for figure in ("ARMATURE", "STIFFNESS", "DAMPING")
        )
        frequency = (stiffness / inertia) ** 0.5
        assert frequency / (2 * np.pi) == pytest.approx(10)
        assert damping / (2 * inertia * frequency) == pytest.approx(2)


def test_where_two_motors_move_a_joint_together_they_are_twice_one():
    one = np.array(GAINS[SHOULDER])
    for cfg in (g1.G1_ACTUATOR_WAIST, g1.G1_ACTUATOR_ANKLE):
        both = (cfg.armature, cfg.stiffness, cfg.damping, cfg.effort_limit)
        np.testing.assert_allclose(both, 2 * one, rtol=1e-8)


def test_the_motors_have_the_limits_of_their_data_sheets():
    motors = (g1.ACTUATOR_5020, g1.ACTUATOR_7520_14, g1.ACTUATOR_7520_22, g1.ACTUATOR_4010)
    limits = [(motor.effort_limit, motor.velocity_limit) for motor in motors]
    assert limits == [(25, 37), (88, 32), (139, 20), (5, 22)]


def test_the_compiled_joints_have_these_gains():
    model = built()
    assert model.nu == 29
    for index in range(model.nu):
        joint = model.joint(model.actuator(index).trnid[0])
        armature, stiffness, damping, effort = GAINS[motor_of(joint.name)]
        assert model.dof_armature[joint.dofadr[0]] == pytest.approx(armature), joint.name
        assert model.actuator_gainprm[index, 0] == pytest.approx(stiffness)
        assert model.actuator_biasprm[index, :3] == pytest.approx([0, -stiffness, -damping])
        assert model.actuator_forcerange[index] == pytest.approx([-effort, effort])


def test_the_action_scale_is_that_of_the_task_tables():
    expected = {pattern: ACTION_SCALES[motor] for pattern, motor in MOTORS.items()}
    assert pytest.approx(expected, rel=1e-9) == g1.G1_ACTION_SCALE


@pytest.mark.parametrize(
    ("keyframe", "height", "angles"),
    [
        (
            "home",
            0.783675,
            {"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "elbow": 1.28},
        ),
        (
            "knees_bent",
            0.76,
            {"hip_pitch": -0.312, "knee": 0.669, "ankle_pitch": -0.363, "elbow": 0.6},
        ),
    ],
)
def test_the_poses_are_those_of_the_task_tables(keyframe, height, angles):
    model = built(init_state=KEYFRAMES[keyframe])
    qpos = model.key_qpos[0]
    assert qpos[:7] == pytest.approx([0, 0, height, 1, 0, 0, 0])
    assert not model.key_qvel.any()
    for index in range(1, model.njnt):
        side, _, kind = model.joint(index).name.removesuffix("_joint").partition("_")
        shoulder = {"shoulder_pitch": 0.2, "shoulder_roll": 0.2 if side == "left" else -0.2}
        expected = 0.0 if side == "waist" else (angles | shoulder).get(kind, 0.0)
        assert qpos[model.jnt_qposadr[index]] == pytest.approx(expected), model.joint(index).name


def test_a_new_config_has_bent_knees_and_full_collisions():
    cfg = get_g1_robot_cfg()
    assert cfg.init_state == g1.KNEES_BENT_KEYFRAME
    assert cfg.collisions == (g1.FULL_COLLISION,)


@pytest.mark.parametrize("keyframe", KEYFRAMES)
def test_each_pose_puts_the_soles_on_the_ground_and_no_part_in_another(keyframe):
    model = built(init_state=KEYFRAMES[keyframe])
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    lowest = []
    for name in FEET:
        geom = model.geom(name).id
        radius, half_length = model.geom_size[geom, :2]
        tilt = abs(data.geom_xmat[geom].reshape(3, 3)[2, 2])
        lowest.append(data.geom_xpos[geom, 2] - half_length * tilt - radius)
    assert -0.001 < min(lowest) < 0.004
    assert np.ptp(lowest) < 0.003


@pytest.mark.parametrize(
    ("collisions", "contype"), [(g1.FULL_COLLISION, 1), (g1.FULL_COLLISION_WITHOUT_SELF, 0)]
)
def test_full_collisions_are_those_of_the_task_tables(collisions, contype):
    model = built(collisions=(collisions,))
    for index in range(model.ngeom):
        geom = model.geom(index)
        felt, foot = "_collision" in geom.name, geom.name in FEET
        assert (geom.contype[0], geom.conaffinity[0]) == ((contype, 1) if felt else (0, 0))
        assert geom.condim[0] == (1 if felt and not foot else 3)
        assert geom.priority[0] == (1 if foot else 0)
        assert geom.friction == pytest.approx([0.6 if foot else 1, 0.005, 0.0001])


def test_feet_only_collisions_leave_nothing_but_the_feet():
    model = built(collisions=(g1.FEET_ONLY_COLLISION,))
    for index in range(model.ngeom):
        geom = model.geom(index)
        foot = geom.name in FEET
        assert (geom.contype[0], geom.conaffinity[0]) == ((0, 1) if foot else (0, 0))
        if foot:
            assert (geom.condim[0], geom.priority[0], geom.friction[0]) == (3, 1, 0.6)


@pytest.mark.parametrize(
    ("collisions", "touches"),
    [(g1.FULL_COLLISION, True), (g1.FULL_COLLISION_WITHOUT_SELF, False)],
)
def test_crossed_legs_touch_only_where_the_robot_collides_with_itself(collisions, touches):
    model = built(collisions=(collisions,))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.joint("left_hip_roll_joint").qpos[0] = -0.3
    data.joint("right_hip_roll_joint").qpos[0] = 0.3
    mujoco.mj_forward(model, data)
    assert (data.ncon > 0) == touches


# In the simulation.


@pytest.mark.parametrize("keyframe", KEYFRAMES)
def test_it_stands_for_a_second_at_its_pose(keyframe):
    # No balance controller: the ankle stiffness is below that of gravity, so that it leans ever
    # further, but slowly.
    cfg = get_g1_robot_cfg()
    cfg.init_state = KEYFRAMES[keyframe]
    scene, sim = scene_of(cfg, MUJOCO, num_envs=2)
    robot = place(scene)
    start = cfg.init_state.pos[2]
    for sunk, upright in ((0.04, 0.998), (0.13, 0.93)):
        sim.step(nstep=100)
        sim.forward()
        height = robot.data.root_link_pos_w[:, 2]
        assert torch.all((height > start - sunk) & (height < start + 0.01))
        assert torch.all(robot.data.projected_gravity_b[:, 2] < -upright)


def test_its_sensors_work_inside_a_scene():
    _, sim = scene_of(get_g1_robot_cfg(), MUJOCO)
    model = sim.mj_model
    assert [model.sensor(i).name for i in range(model.nsensor)] == [
        f"robot/{sensor['name']}" for sensor in TABLE["sensors"]
    ]
    turn_on_its_side(sim)
    sim.data.qvel[0, 3] = 0.5
    sim.forward()

    def reading(name: str) -> torch.Tensor:
        address = model.sensor(f"robot/{name}").adr[0]
        return sim.data.sensordata[0, address : address + 3]

    def assert_close(name: str, expected: list[float]) -> None:
        torch.testing.assert_close(reading(name), torch.tensor(expected), atol=1e-6, rtol=0)

    assert_close("imu_upvector", [0.0, 1.0, 0.0])
    assert_close("imu_ang_vel", [0.5, 0.0, 0.0])
    # The velocity w x r of the site, 83.39 mm below the rotation axis.
    assert_close("imu_lin_vel", [0.0, 0.5 * 0.08339, 0.0])
    # The robot turns about x as one body: a few kg m^2 times half a rad/s.
    assert 1.0 < float(reading("root_angmom")[0]) < 3.0


def test_what_is_drawn_changes_neither_masses_nor_contacts():
    on_its_back = dict(enumerate([0.2, 0.5**0.5, 0, -(0.5**0.5), 0], start=2))
    check_drawing_changes_nothing(get_g1_robot_cfg(), MUJOCO, on_its_back, at_least=61)
