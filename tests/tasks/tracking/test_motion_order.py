"""Motions in the order of other tools: forward kinematics tells the order."""

from __future__ import annotations

import collections
import warnings
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.entity import EntityCfg
from mjlab.scripts.csv_to_npz import CsvToNpzConfig, convert
from mjlab.tasks.tracking.motion_file import PER_BODY, PER_JOINT, MotionFileError, read_motion
from mjlab.tasks.tracking.motion_order import Skeleton, arranged
from mjlab.tasks.tracking.motion_recording import Recording, make_motion
from mjlab.tasks.tracking.motion_sources import shipped_motions

G1 = Skeleton.of_entity(get_g1_robot_cfg().build())
WAVE = read_motion(shipped_motions()["wave"])
NO_NAMES = replace(WAVE, joint_names=(), body_names=())


def breadth_first() -> tuple[list[int], list[int]]:
    """Return joints and bodies of the G1 from the pelvis outwards."""
    queue, order = collections.deque([1]), []
    while queue:
        order.append(body := queue.popleft())
        queue.extend(np.flatnonzero(G1.model.body_parentid == body).tolist())
    of_joint = [G1.model.jnt_bodyid[j] for j in G1.joints]
    return [of_joint.index(b) for b in order if b in of_joint], [b - 1 for b in order]


def alphabetical() -> tuple[list[int], list[int]]:
    """Return joints and bodies of the G1 by name."""
    return (
        sorted(range(29), key=G1.joint_names.__getitem__),
        sorted(range(30), key=G1.body_names.__getitem__),
    )


def shuffled() -> tuple[list[int], list[int]]:
    """Return joints and bodies of the G1 in a random order."""
    random = np.random.default_rng(3)
    return random.permutation(29).tolist(), random.permutation(30).tolist()


def in_order(joints, bodies, motion=NO_NAMES):
    """Return the motion as a tool with another order writes it."""
    changes = {key: getattr(motion, key)[:, joints] for key in PER_JOINT}
    changes |= {key: getattr(motion, key)[:, bodies] for key in PER_BODY}
    return replace(motion, **changes)


def distance(motion) -> float:
    """Return the largest distance (m) of bodies from plain forward kinematics."""
    data, worst = mujoco.MjData(G1.model), 0.0
    for frame in range(0, motion.num_frames, 20):
        root = motion.body_pos_w[frame, 0], motion.body_quat_w[frame, 0]
        data.qpos[:] = np.concatenate((*root, motion.joint_pos[frame]))
        mujoco.mj_kinematics(G1.model, data)
        worst = max(worst, np.linalg.norm(data.xpos[1:] - motion.body_pos_w[frame], axis=1).max())
    return worst


def assert_equal(one, other) -> None:
    for key in (*PER_JOINT, *PER_BODY):
        np.testing.assert_allclose(getattr(one, key), getattr(other, key), atol=1e-4, err_msg=key)


@pytest.mark.parametrize("name", shipped_motions())
def test_right_files_agree_and_are_left_alone(name):
    motion = read_motion(shipped_motions()[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert arranged("", motion, G1) is motion
    assert distance(motion) < 2e-5


@pytest.mark.parametrize("order", [breadth_first, alphabetical, shuffled])
@pytest.mark.parametrize("mixed", ["both", "joints", "bodies"])
def test_the_order_is_found_from_the_poses(order, mixed):
    joints, bodies = order()
    motion = in_order(
        joints if mixed != "bodies" else range(29), bodies if mixed != "joints" else range(30)
    )
    with pytest.warns(UserWarning, match="order of the robot") as warned:
        found = arranged("dance.npz", motion, G1)
    assert len(warned) == 1
    assert_equal(found, NO_NAMES)
    assert distance(found) < 1e-3


@pytest.mark.parametrize("order", [None, breadth_first])
def test_quaternions_with_w_last_are_found(order):
    motion = NO_NAMES if order is None else in_order(*order())
    motion = replace(motion, body_quat_w=np.roll(motion.body_quat_w, -1, axis=-1))
    with pytest.warns(UserWarning, match="x, y, z, w"):
        assert_equal(arranged("", motion, G1), NO_NAMES)


def test_joints_that_move_alike_stay_in_their_columns():
    squat = replace(read_motion(shipped_motions()["squat"]), joint_names=(), body_names=())
    motion = replace(squat, body_quat_w=np.roll(squat.body_quat_w, -1, axis=-1))
    with pytest.warns(UserWarning, match="0 joints and 0 bodies"):
        found = arranged("", motion, G1)
    np.testing.assert_array_equal(found.joint_pos, squat.joint_pos)


def test_columns_follow_the_names_of_the_file():
    joints, bodies = shuffled()
    motion = replace(
        in_order(joints, bodies),
        joint_names=tuple(G1.joint_names[i] for i in joints),
        body_names=tuple(G1.body_names[i] for i in bodies),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_equal(arranged("", motion, G1), NO_NAMES)
    wider = replace(
        motion,
        joint_names=("hand", *motion.joint_names),
        **{key: np.pad(getattr(motion, key), ((0, 0), (1, 0))) for key in PER_JOINT},
    )
    assert_equal(arranged("", wider, G1), NO_NAMES)


def test_names_in_another_order_than_the_columns_are_a_warning():
    motion = replace(WAVE, joint_names=WAVE.joint_names[::-1])
    with pytest.warns(UserWarning, match="names .* not in the order of the columns"):
        assert_equal(arranged("", motion, G1), WAVE)


def test_another_origin_or_more_bodies_are_no_fault():
    higher = replace(NO_NAMES, body_pos_w=NO_NAMES.body_pos_w + np.float32([3.0, -2.0, 0.4]))
    more = {key: np.concatenate((getattr(NO_NAMES, key),) * 2, axis=1)[:, :33] for key in PER_BODY}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert arranged("", higher, G1) is higher
        assert_equal(arranged("", replace(NO_NAMES, **more), G1), NO_NAMES)


def test_poses_that_no_order_explains_are_one_warning(tmp_path):
    motion = replace(NO_NAMES, joint_pos=NO_NAMES.joint_pos + 0.5)
    with pytest.warns(UserWarning, match=r"up to 0\.\d+ m .* no other order") as warned:
        assert arranged("dance.npz", motion, G1) is motion
    assert len(warned) == 1
    path = tmp_path / "dance.npz"
    np.savez(path, fps=50.0, **{key: getattr(motion, key) for key in (*PER_JOINT, *PER_BODY)})
    with pytest.raises(MotionFileError, match=r"dance.npz: bodies are up to 0\.\d+ m"):
        convert(CsvToNpzConfig(input_file=str(path), output_file=str(tmp_path / "out.npz")))


def test_a_file_in_another_order_is_converted(tmp_path):
    path, joints_bodies = tmp_path / "dance.npz", breadth_first()
    motion = in_order(*joints_bodies)
    np.savez(path, fps=50.0, **{key: getattr(motion, key) for key in (*PER_JOINT, *PER_BODY)})
    with pytest.warns(UserWarning, match="order of the robot"):
        out = convert(CsvToNpzConfig(input_file=str(path), output_file=str(tmp_path / "out.npz")))
    written = read_motion(out)
    np.testing.assert_allclose(written.joint_pos, WAVE.joint_pos[: written.num_frames], atol=1e-6)
    assert written.joint_names == G1.joint_names


def test_slides_anchors_and_several_joints_per_body():
    spec = mujoco.MjSpec.from_string("""
    <mujoco><compiler angle="radian"/><worldbody><body name="base"><freejoint/><geom size=".1"/>
      <body name="arm" pos=".2 0 .1" euler=".3 0 .2"><geom size=".1"/>
        <joint name="roll" axis="1 0 0" pos=".05 .02 0"/><joint name="yaw" axis="0 0 1"/>
        <body name="hand" pos="0 .3 0"><joint name="reach" type="slide" axis="0 1 0"/>
          <geom size=".1"/><body name="tip" pos="0 .1 0"><geom size=".1"/></body></body></body>
      <body name="tail" pos="-.3 0 0"><joint name="wag" axis="0 1 0" ref=".4"/><geom size=".1"/>
      </body></body></worldbody></mujoco>""")
    robot = EntityCfg(spec_fn=lambda: spec).build()
    skeleton = Skeleton.of_entity(robot)
    t = np.linspace(0.0, 2.0, 30)[:, None]
    recording = Recording(
        fps=50.0,
        root_pos=np.hstack((t, 0 * t, 1 + 0 * t)),
        root_quat=np.hstack((np.cos(t), 0 * t, 0 * t, np.sin(t))),
        joint_pos=np.hstack((0.5 * np.sin(t), 0.4 * t, 0.1 * np.cos(3 * t), 0.4 + 0.3 * t**2)),
    )
    motion = make_motion(recording, skeleton.model)
    with pytest.warns(UserWarning, match="order of the robot"):
        found = arranged("", in_order([3, 1, 0, 2], [4, 0, 3, 1, 2], motion), skeleton)
    assert_equal(found, motion)


def test_many_joints_with_three_on_each_body():
    random = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    bodies = [spec.worldbody.add_body(name="base")]
    bodies[0].add_freejoint()
    for i in range(12):
        body = bodies[random.integers(len(bodies))].add_body(name=f"body{i}")
        body.pos = 0.2 * random.normal(size=3)
        for k, axis in enumerate(np.eye(3)):
            body.add_joint(name=f"joint{i}_{k}", axis=axis)
        bodies.append(body)
    for body in bodies:
        body.add_geom(size=[0.05, 0.0, 0.0])
    skeleton = Skeleton.of_entity(EntityCfg(spec_fn=lambda: spec).build())
    t = np.linspace(0.0, 2.0, 60)[:, None]
    joint_pos = 0.8 * np.sin(t * random.uniform(1.0, 4.0, 36) + random.uniform(0.0, 6.0, 36))
    recording = Recording(
        fps=50.0,
        root_pos=np.hstack((t, 0 * t, 1 + 0 * t)),
        root_quat=np.hstack((np.cos(t), 0 * t, 0 * t, np.sin(t))),
        joint_pos=joint_pos,
    )
    motion = make_motion(recording, skeleton.model)
    order = random.permutation(36), random.permutation(13)
    with pytest.warns(UserWarning, match="order of the robot"):
        assert_equal(arranged("", in_order(*order, motion), skeleton), motion)


def test_the_command_plays_another_order_rightly(make_env, tmp_path):
    path = tmp_path / "breadth_first.npz"
    motion = in_order(*breadth_first())
    np.savez(path, fps=50.0, **{key: getattr(motion, key) for key in (*PER_JOINT, *PER_BODY)})
    with pytest.warns(UserWarning, match="order of the robot"):
        env = make_env(path, num_envs=2)
    command = env.command_manager.get_term("motion")
    torch.testing.assert_close(command.motion.joint_pos, torch.from_numpy(WAVE.joint_pos))
    expected = WAVE.body_pos_w[:, command.body_indexes.numpy()]
    torch.testing.assert_close(command.motion.body_pos_w, torch.from_numpy(expected))
