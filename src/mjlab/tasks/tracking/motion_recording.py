"""Recordings of root and joint poses: resampling, conversion to motions, and CSV I/O.

CSV files have the layout of the retargeted LAFAN1 data: comma-separated, one pose per line: root
position (m), root quaternion (x, y, z, w), and all joint angles (rad) in robot order. A header line
with names may give another order of the columns.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from mjlab.tasks.tracking.motion_file import Motion, MotionFileError
from mjlab.utils.memory import check_memory
from mjlab.utils.string import is_number

_ROOT_COLUMNS = 7
_QUAT_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """T equally spaced poses of a robot with a floating base and nj joints."""

    fps: float
    """Poses per second."""
    root_pos: np.ndarray
    """Position of the floating base (m), (T, 3)."""
    root_quat: np.ndarray
    """Orientation of the floating base, unit quaternions (w, x, y, z), (T, 4)."""
    joint_pos: np.ndarray
    """Joint positions (rad) in robot order, (T, nj)."""

    def __len__(self) -> int:
        return len(self.root_pos)


def make_motion(
    recording: Recording,
    model: mujoco.MjModel,
    joint_names: tuple[str, ...] = (),
    body_names: tuple[str, ...] = (),
) -> Motion:
    """Return the motion of a recording: adds velocities, and poses and velocities of all bodies.

    Root and joint velocities are central differences; body velocities follow from them. At both
    ends, linear and joint velocities are one-sided differences, and the angular velocity of the
    root is that of the neighboring pose, as in mjlab 1.6.

    Args:
        recording: At least two poses.
        model: Model of the robot alone; its first joint is a free joint.
        joint_names: Joint names of the motion.
        body_names: Body names of the motion.

    Raises:
        ValueError: fewer than two poses, different number of joints, or no free joint.
    """
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError("Robot: expected a free joint as the first joint, got a fixed base.")
    if recording.joint_pos.shape[1] != model.nq - 7:
        raise ValueError(
            f"Recording: expected {model.nq - 7} joints, got {recording.joint_pos.shape[1]}."
        )
    dt = 1.0 / recording.fps
    lin_vel = np.gradient(recording.root_pos, dt, axis=0)
    ang_vel = angular_velocities(recording.root_quat, dt)
    joint_vel = np.gradient(recording.joint_pos, dt, axis=0)
    data = mujoco.MjData(model)
    frames: list[tuple[np.ndarray, ...]] = []
    for t in range(len(recording)):
        data.qpos[:3], data.qpos[3:7] = recording.root_pos[t], recording.root_quat[t]
        data.qpos[7:] = recording.joint_pos[t]
        # Angular velocity in qvel of a free joint is in the body frame.
        back = recording.root_quat[t] * (1.0, -1.0, -1.0, -1.0)
        mujoco.mju_rotVecQuat(data.qvel[3:6], ang_vel[t], back)
        data.qvel[:3], data.qvel[6:] = lin_vel[t], joint_vel[t]
        frames.append(_bodies(model, data))
    pos, quat, linear, angular = (np.stack(values) for values in zip(*frames, strict=True))
    return Motion(
        fps=recording.fps,
        joint_pos=recording.joint_pos.astype(np.float32),
        joint_vel=joint_vel.astype(np.float32),
        body_pos_w=pos.astype(np.float32),
        body_quat_w=quat.astype(np.float32),
        body_lin_vel_w=linear.astype(np.float32),
        body_ang_vel_w=angular.astype(np.float32),
        joint_names=tuple(joint_names),
        body_names=tuple(body_names),
    )


def _bodies(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, ...]:
    """Return positions, orientations, linear and angular velocities of all bodies except the
    world."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    pos, angular = data.xpos[1:].copy(), data.cvel[1:, :3].copy()
    center = data.subtree_com[model.body_rootid[1:]]
    linear = data.cvel[1:, 3:] + np.cross(angular, pos - center)
    return pos, data.xquat[1:].copy(), linear, angular


def recording_of(motion: Motion, fps: float) -> Recording:
    """Return the poses of a motion; body 0 is the floating base."""
    quat = motion.body_quat_w[:, 0].astype(np.float64)
    return Recording(
        fps=fps,
        root_pos=motion.body_pos_w[:, 0].astype(np.float64),
        root_quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        joint_pos=motion.joint_pos.astype(np.float64),
    )


def angular_velocities(quats: np.ndarray, dt: float) -> np.ndarray:
    """Return angular velocities in world axes, (T, 3), of orientations (T, 4) dt apart.

    log(q_(t+1) q_(t-1)*) / (2 dt). The first and last values repeat their neighbors; for two
    orientations, both are the forward difference.
    """
    if len(quats) < 3:
        return np.repeat(_rotation_vectors(quats[:-1], quats[1:]) / dt, len(quats), axis=0)
    inner = _rotation_vectors(quats[:-2], quats[2:]) / (2.0 * dt)
    return np.concatenate((inner[:1], inner, inner[-1:]))


def _rotation_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return log(end start*), (n, 3)."""
    result = np.empty((len(start), 3))
    relative, back = np.empty(4), np.empty(4)
    for i in range(len(start)):
        mujoco.mju_negQuat(back, start[i])
        mujoco.mju_mulQuat(relative, end[i], back)
        mujoco.mju_quat2Vel(result[i], relative, 1.0)
    return result


def resampled(recording: Recording, fps: float) -> Recording:
    """Resample a recording: linear positions, slerp orientations on the shortest arc.

    Times are 0, 1/fps, 2/fps, ... up to, but excluding, the last pose: 301 poses at 30 per second
    become 500 at 50 per second.

    Raises:
        ValueError: fewer than two poses remain.
    """
    intervals = len(recording) - 1
    # 1e-6 absorbs rounding, so that 10.000000001 s counts as 10 s.
    count = math.ceil(min(intervals * fps / recording.fps, 1e18) - 1e-6)
    if count < 2:
        raise ValueError(
            f"Recording: expected at least 2 poses at {fps:g} per second, got {max(count, 0)} from "
            f"{len(recording)} poses at {recording.fps:g} per second."
        )
    # Two neighbors and the pose between them.
    size = 3 * 8 * (7 + recording.joint_pos.shape[1])
    check_memory("poses of the recording", count, size, "cpu", f"less than {fps:g} per second")
    phase = np.arange(count) * (recording.fps / fps)
    # Times that coincide with a pose return the pose without interpolation.
    phase = np.where(
        np.abs(phase - np.round(phase)) < 1e-9 * len(recording), np.round(phase), phase
    )
    first = np.floor(phase).astype(int)
    blend = (phase - first)[:, None]
    second = np.minimum(first + 1, intervals)

    def linear(values: np.ndarray) -> np.ndarray:
        return values[first] * (1.0 - blend) + values[second] * blend

    return Recording(
        fps=fps,
        root_pos=linear(recording.root_pos),
        root_quat=slerp(recording.root_quat[first], recording.root_quat[second], blend),
        joint_pos=linear(recording.joint_pos),
    )


def slerp(start: np.ndarray, end: np.ndarray, blend: np.ndarray) -> np.ndarray:
    """Interpolate unit quaternions (..., 4) at constant angular velocity on the shortest arc.

    (sin((1 - t) a) q0 + sin(t a) q1) / sin(a), a: angle between q0 and q1, written with sin(x)/x
    for accuracy at small angles: slow rotations stay smooth.

    Args:
        start: (..., 4).
        end: (..., 4).
        blend: (..., 1), 0 for `start` and 1 for `end`.
    """
    end = np.where((start * end).sum(axis=-1, keepdims=True) < 0.0, -end, end)
    # atan2 of chord lengths is accurate at small angles, acos is not.
    chord = np.linalg.norm(end - start, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(chord, np.linalg.norm(end + start, axis=-1, keepdims=True))

    def weight(t: np.ndarray) -> np.ndarray:
        return t * np.sinc(t * angle / np.pi) / np.sinc(angle / np.pi)

    mixed = weight(1.0 - blend) * start + weight(blend) * end
    return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)


# CSV.


def read_csv(
    path: str | Path,
    fps: float,
    joint_names: Sequence[str],
    line_range: tuple[int, int] | None = None,
) -> Recording:
    """Read a recording from a CSV file.

    With a header, joints are found by name, with or without the ending `_joint` or `_dof`; columns of
    the root by their last letter (`qw`, `root_rot_x`); columns `frame` and `time` are not read. A header
    without the joints is a warning, and not used. Without these letters, the quaternion is taken as (w, x, y, z), with a warning, if only then the robot
    stands upright.

    Args:
        path: CSV file.
        fps: Poses per second of the file.
        joint_names: Joints of the robot, in order.
        line_range: First and last pose to read, 1-based, inclusive. None: all poses.

    Raises:
        MotionFileError: file not found, not a table of numbers, wrong number of columns, line range
            outside of the file, fewer than two poses, or a quaternion of norm 0.
    """
    path = Path(path)
    names, table = _table(path)
    first, last = (1, len(table)) if line_range is None else line_range
    if line_range is not None and not 1 <= first <= last <= len(table):
        raise MotionFileError(
            f"line_range: expected lines within 1 to {len(table)} of {path}, got {first} to {last}."
        )
    table = table[first - 1 : last]
    if len(table) < 2:
        raise MotionFileError(f"{path}: expected at least 2 poses, got {len(table)}.")
    joints, root, is_named = _columns(names, joint_names)
    expected = _ROOT_COLUMNS + len(joint_names)
    if table.shape[1] != (len(names) if is_named else expected):
        raise MotionFileError(
            f"{path}: expected {expected} columns, got {table.shape[1]}. The columns are position "
            f"(3), orientation x y z w (4) and joints ({len(joint_names)}): {list(joint_names)}; "
            "columns in another order need a header with these names."
        )
    if not np.isfinite(table).all():
        line = int(np.argwhere(~np.isfinite(table))[0][0]) + first
        raise MotionFileError(f"Line {line} of {path}: expected finite numbers, got NaN or inf.")
    if names and not is_named:
        plain = [_plain(name) for name in names]
        warnings.warn(
            f"{path}: expected one column for each joint of the robot in the header, got others for "
            f"{[name for name in joint_names if plain.count(_plain(name)) != 1]}; the names are "
            "ignored, and the columns taken in the order of the robot.",
            UserWarning,
            stacklevel=2,
        )
    quat = table[:, root[3:]]
    norms = np.linalg.norm(quat, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(norms[:, 0] - 1.0) > _QUAT_TOLERANCE)
    if len(wrong) > 0:
        problem = (
            f"Line {wrong[0] + first} of {path}: expected a unit quaternion (x y z w) in columns 4 to "
            f"7, got norm {norms[wrong[0], 0]:.4g}"
        )
        if not norms.all():
            raise MotionFileError(f"{problem}.")
        warnings.warn(f"{problem}; normalized.", UserWarning, stacklevel=2)
    quat = quat / norms
    if not is_named and np.median(_upright(quat)) < 0.5 <= np.min(_upright(quat[:, [1, 2, 3, 0]])):
        warnings.warn(
            f"{path}: expected quaternions x y z w in columns 4 to 7, got a robot that lies or stands "
            "on its head; taken as w x y z, it is upright in all poses, which is used. Name the "
            "columns in a header to select their order.",
            UserWarning,
            stacklevel=2,
        )
        quat = quat[:, [1, 2, 3, 0]]
    return Recording(
        fps=fps, root_pos=table[:, root[:3]], root_quat=quat, joint_pos=table[:, joints]
    )


def _upright(quat: np.ndarray) -> np.ndarray:
    """Return the vertical component of the robot's z axis, of quaternions (w, x, y, z)."""
    return 1.0 - 2.0 * (quat[:, 1] ** 2 + quat[:, 2] ** 2)


def _columns(names: Sequence[str], joint_names: Sequence[str]) -> tuple[list[int], list[int], bool]:
    """Return the columns of the joints, of the root (x y z, qw qx qy qz), and if they are named."""
    joints = list(range(_ROOT_COLUMNS, _ROOT_COLUMNS + len(joint_names)))
    plain = [_plain(name) for name in names]
    if any(plain.count(_plain(name)) != 1 for name in joint_names):
        return joints, [0, 1, 2, 6, 3, 4, 5], False
    joints = [plain.index(_plain(name)) for name in joint_names]
    skipped = {
        i for i, name in enumerate(plain) if name in ("", "frame", "index", "time", "timestamp")
    }
    rest = [i for i in range(len(names)) if i not in {*joints, *skipped}]
    letters = "".join(plain[i][-1] for i in rest)
    # The quaternion is the block with w, and its names differ in the last letter only: in
    # qx qy qz qw x y z, it is not qw x y z.
    starts = (3, 0) if len(rest) == _ROOT_COLUMNS else ()
    for start in sorted(starts, key=lambda k: len({plain[i][:-1] for i in rest[k : k + 4]})):
        quat, pos = rest[start : start + 4], rest[:start] + rest[start + 4 :]
        letter = {i: letters[rest.index(i)] for i in rest}
        if sorted(letter[i] for i in quat) == list("wxyz"):
            ordered = sorted(pos, key=letter.__getitem__) + sorted(quat, key=letter.__getitem__)
            return joints, ordered, True
    raise MotionFileError(
        f"Header: expected the joints, and x y z and qx qy qz qw of the root, got {list(names)}."
    )


def _plain(name: str) -> str:
    return re.sub("(_joint|_dof|_pos)+$", "", name.strip().strip('"').lower())


def _table(path: Path) -> tuple[list[str], np.ndarray]:
    """Return the names of the columns, empty without a header, and the numbers."""
    if not path.is_file():
        raise MotionFileError(f"File {path} not found.")
    try:
        # Some tools begin files with a byte order mark.
        with path.open(encoding="utf-8-sig") as file:
            cells = file.readline().lstrip("# ").rstrip().split(",")
            is_named = len(cells) > 1 and not any(map(is_number, cells))
            # Some tools number the columns of a table without names.
            is_header = is_named or cells == [str(i) for i in range(len(cells))]
            file.seek(0)
            with warnings.catch_warnings():
                # np.loadtxt warns about empty files; `read_csv` raises for them.
                warnings.simplefilter("ignore", UserWarning)
                table = np.loadtxt(file, delimiter=",", ndmin=2, skiprows=int(is_header))
        return cells if is_named else [], table
    except ValueError as error:
        raise MotionFileError(
            f"{path} is not a table of numbers (comma-separated): {error}"
        ) from error


def write_csv(path: str | Path, recording: Recording) -> None:
    """Write a recording to a CSV file."""
    quat = recording.root_quat[:, [1, 2, 3, 0]]
    table = np.hstack((recording.root_pos, quat, recording.joint_pos))
    np.savetxt(path, table, delimiter=",", fmt="%.8f")
