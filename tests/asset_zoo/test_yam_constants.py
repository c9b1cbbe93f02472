"""I2RT YAM: parameters equal the tables, the robot holds its pose, and drawing changes nothing."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from robot_scenes import check_drawing_changes_nothing, compiled, scene_of

from mjlab.asset_zoo.robots import get_yam_robot_cfg
from mjlab.asset_zoo.robots.i2rt_yam import yam_constants as yam
from mjlab.entity import Entity
from mjlab.sim import MujocoCfg, Simulation

FINGERTIPS = {f"{side}f_down{number}_collision" for side in "lr" for number in range(6, 12)}
# The settings of the manipulation tasks.
MUJOCO = MujocoCfg(timestep=0.005, impratio=10, cone="elliptic", iterations=10, ls_iterations=20)
# Joint: armature, stiffness, damping, effort limit and action scale, from the task tables.
ACTUATORS = {
    "joint1": (0.032, 19.44754225, 6.190344961, 28.0, 0.3599426554),
    "joint2": (0.032, 43.80698922, 13.94419775, 28.0, 0.1597918534),
    "joint3": (0.032, 36.75645967, 11.69994449, 28.0, 0.1904427157),
    "joint4": (0.0018, 4.761728817, 1.515705358, 10.0, 0.5250193986),
    "joint5": (0.0018, 1.441120156, 0.4587227929, 10.0, 1.734761664),
    "joint6": (0.0018, 0.4528964067, 0.1441614037, 10.0, 5.520026131),
    "left_finger": (2.603054949, 109.8141139, 69.90983619, 38.02816901, 0.08657395591),
}
HOME = [0.0, 1.047, 1.05, -0.9, 0.0, 0.0, 0.01875, -0.01875]


def at_home(num_envs: int = 1) -> tuple[Simulation, Entity]:
    """Return arms on a plane that hold their home pose, and their simulation."""
    scene, sim = scene_of(get_yam_robot_cfg(), MUJOCO, num_envs)
    robot: Entity = scene["robot"]
    robot.write_joint_state_to_sim(robot.data.default_joint_pos, robot.data.default_joint_vel)
    hold(robot, robot.data.default_joint_pos)
    sim.forward()
    return sim, robot


def hold(robot: Entity, joint_pos: torch.Tensor) -> None:
    robot.set_joint_position_target(joint_pos)
    robot.write_data_to_sim()


def built(**changes) -> mujoco.MjModel:
    return compiled(get_yam_robot_cfg(), **changes)


def test_the_spotlight_follows_the_gripper():
    model = yam.get_spec().compile()
    light = model.light("spotlight")
    assert model.nlight == 1
    assert light.mode[0] == mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM
    assert light.targetbodyid[0] == model.body("link_6").id
    assert light.bodyid[0] == 0
    assert light.type[0] == mujoco.mjtLightType.mjLIGHT_SPOT
    np.testing.assert_allclose(light.pos, [0, 0, 1])
    np.testing.assert_allclose(light.diffuse, 0.7)
    np.testing.assert_allclose(light.specular, 0.3)
    np.testing.assert_allclose(light.ambient, 0.0)
    assert (light.cutoff[0], light.exponent[0]) == (45, 10)


def test_the_cameras_are_those_of_the_behavior_page():
    model = yam.get_spec().compile()
    front, wrist = model.camera("front_cam"), model.camera("camera_d405").id
    assert front.bodyid[0] == 0
    np.testing.assert_allclose(front.pos, [1.1, 0, 0.5])
    np.testing.assert_allclose(front.quat, [0.59032, 0.38926, 0.38926, 0.59032], atol=1e-5)
    assert front.fovy[0] == 45
    # Focal lengths and sensor of the Intel D405; from them follows the vertical field of view.
    np.testing.assert_allclose(model.cam_intrinsic[wrist], [0.00193, 0.00193, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(model.cam_sensorsize[wrist], [0.003896, 0.00214], rtol=1e-6)
    assert model.cam_fovy[wrist] == pytest.approx(np.degrees(2 * np.arctan2(0.00214 / 2, 0.00193)))


def test_the_wrist_camera_sees_what_is_between_the_fingers():
    model = built()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    axes = data.camera("camera_d405").xmat.reshape(3, 3)
    seen = axes.T @ (data.site("grasp_site").xpos - data.camera("camera_d405").xpos)
    # A camera looks along its -z.
    assert seen[2] < -0.05
    half_field = np.tan(np.radians(model.camera("camera_d405").fovy[0] / 2))
    assert np.all(np.abs(seen[:2]) < -seen[2] * half_field)


# The config, with the numbers of the task tables.


def test_motors_and_gains_are_those_of_the_task_tables():
    articulation = get_yam_robot_cfg().articulation
    found = {
        cfg.target_names_expr: (cfg.armature, cfg.stiffness, cfg.damping, cfg.effort_limit)
        for cfg in articulation.actuators
    }
    assert found == {
        (joint,): pytest.approx(figures[:4], rel=1e-9) for joint, figures in ACTUATORS.items()
    }
    assert articulation.soft_joint_pos_limit_factor == 0.9
    assert [motor.velocity_limit for motor in (yam.DM_4340, yam.DM_4310)] == [
        10.0,
        30.0,
    ]


def test_the_compiled_joints_have_these_gains_and_the_right_finger_none():
    model = built()
    assert [model.joint(id_).name for id_ in model.actuator_trnid[:, 0]] == list(ACTUATORS)
    for index, (armature, stiffness, damping, effort, _) in enumerate(ACTUATORS.values()):
        assert model.actuator_gainprm[index, 0] == pytest.approx(stiffness)
        assert model.actuator_biasprm[index, :3] == pytest.approx([0, -stiffness, -damping])
        assert model.actuator_forcerange[index] == pytest.approx([-effort, effort])
        assert model.dof_armature[index] == pytest.approx(armature)
    assert model.dof_armature[model.joint("right_finger").dofadr[0]] == 0


def test_the_action_scale_is_that_of_the_task_tables():
    expected = {joint: figures[4] for joint, figures in ACTUATORS.items()}
    assert pytest.approx(expected, rel=1e-9) == yam.YAM_ACTION_SCALE


def test_the_gains_are_those_of_the_inertia_at_home():
    model = built()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    expected = [yam.EFFECTIVE_INERTIAS[joint] for joint in ACTUATORS]
    # Printed with six decimals.
    np.testing.assert_allclose(np.diag(inertia)[:7], expected, atol=6e-7)


def test_the_home_pose_is_that_of_the_task_tables():
    model = built()
    assert model.key_qpos[0] == pytest.approx(HOME)
    assert not model.key_qvel.any()
    assert model.body("arm").pos[2] + model.body(1).pos[2] == pytest.approx(0.01)


@pytest.mark.parametrize("preset", ["full", "gripper only"])
def test_collisions_are_those_of_the_task_tables(preset):
    collisions = yam.FULL_COLLISION if preset == "full" else yam.GRIPPER_ONLY_COLLISION
    model = built(collisions=(collisions,))
    for index in range(model.ngeom):
        geom = model.geom(index)
        felt, tip = "_collision" in geom.name, geom.name in FINGERTIPS
        gripper = geom.name.startswith(("link6_", "lf_", "rf_"))
        on = felt and (gripper or preset == "full")
        assert (geom.contype[0], geom.conaffinity[0]) == ((1, 1) if on else (0, 0))
        assert geom.condim[0] == (6 if tip else 3)
        assert geom.priority[0] == (1 if tip else 0)
        slide = 0.6 if felt else 1
        assert geom.friction == pytest.approx([1, 5e-3, 5e-4] if tip else [slide, 5e-3, 1e-4])
        assert geom.solref == pytest.approx([0.01, 1] if tip else [0.02, 1])
    assert {model.geom(index).name for index in range(model.ngeom)} >= FINGERTIPS


def test_a_new_config_collides_with_the_gripper_only():
    assert get_yam_robot_cfg().collisions == (yam.GRIPPER_ONLY_COLLISION,)


# In the simulation.


def test_it_holds_its_home_pose_for_two_seconds_within_a_hand():
    # The springs are soft: the arm sinks a little under its own weight.
    sim, robot = at_home(num_envs=2)
    start = robot.data.site_pos_w.clone()
    sim.step(nstep=400)
    sim.forward()
    assert (robot.data.site_pos_w - start).norm(dim=-1).max() < 0.12
    assert robot.data.joint_vel.abs().max() < 0.02


@pytest.mark.parametrize("target", [0.0, 0.036])
def test_one_motor_opens_and_closes_both_fingers_alike(target):
    sim, robot = at_home()
    finger = robot.joint_names.index("left_finger")
    goal = robot.data.default_joint_pos.clone()
    goal[:, finger] = target
    hold(robot, goal)
    sim.step(nstep=400)
    left, right = robot.data.joint_pos[0, finger : finger + 2].tolist()
    assert left == pytest.approx(target, abs=2e-3)
    assert right == pytest.approx(-left, abs=1e-3)


def test_what_is_drawn_changes_neither_masses_nor_contacts():
    # Reaching down, so that it pushes its fingers against the ground.
    cfg = get_yam_robot_cfg()
    cfg.collisions = (yam.FULL_COLLISION,)
    cfg.init_state.joint_pos["joint2"] = 1.7
    check_drawing_changes_nothing(cfg, MUJOCO, {}, at_least=45)
