"""Order of the joints and bodies of a motion, from forward kinematics.

Files of other tools may have the joints and bodies of the robot in another order, such as breadth
first, or quaternions as (x, y, z, w). The poses of the bodies tell the order: each body must be where
its parent and its joints place it.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from mjlab.tasks.tracking.motion_file import PER_BODY, PER_JOINT, Motion, MotionFileError
from mjlab.utils.lab_api.math import convert_quat, quat_apply, quat_from_angle_axis, quat_mul

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.tasks.tracking.motion_recording import Recording

# Distance (m) and chord of unit quaternions up to which poses agree; files of csv-to-npz agree to
# 1e-6.
_TOLERANCE = 1e-3
# Larger differences are reported if no order explains them.
_NOTABLE = 1e-2
# Excess over joint limits (rad or m) that is reported, and of an order or unit that is used instead.
# Retargeted motions exceed limits by some tenths.
_OUTSIDE = 0.4
_WITHIN = 0.1
# Difference in error (m, chord) between joints that move alike, such as two at rest.
_ALIKE = 1e-5
_NUM_SPREAD = 8


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """Bodies and joints of a robot with a floating base, within a compiled model."""

    model: mujoco.MjModel
    """Model of the robot or of a scene with the robot."""
    bodies: tuple[int, ...]
    """Ids of the bodies; the first is the floating base."""
    joints: tuple[int, ...]
    """Ids of the joints, without the free joint."""
    body_names: tuple[str, ...]
    """Names of `bodies`."""
    joint_names: tuple[str, ...]
    """Names of `joints`."""

    @classmethod
    def of_entity(cls, robot: Entity, scene: mujoco.MjModel | None = None) -> Skeleton:
        """Return the skeleton of a robot: compiled alone, or within the model of its scene."""
        if scene is None:
            first = 0 if robot.is_fixed_base else 1
            model, joints = robot.compile(), range(first, first + robot.num_joints)
            bodies: Sequence[int] = range(1, 1 + robot.num_bodies)
        else:
            model, joints = scene, robot.indexing.joint_ids.tolist()
            bodies = robot.indexing.body_ids.tolist()
        return cls(
            model=model,
            bodies=tuple(bodies),
            joints=tuple(joints),
            body_names=robot.body_names,
            joint_names=robot.joint_names,
        )

    @property
    def is_comparable(self) -> bool:
        """True if the base is floating, and each joint has one position."""
        model, root = self.model, self.bodies[0]
        kinds = model.jnt_type[list(self.joints)].tolist() if self.joints else []
        return (
            model.body_jntnum[root] == 1
            and model.jnt_type[model.body_jntadr[root]] == mujoco.mjtJoint.mjJNT_FREE
            and set(kinds) <= {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
        )

    def joints_of(self, body: int) -> list[int]:
        """Return the columns of the joints of a body, counted in the robot."""
        return [i for i, j in enumerate(self.joints) if self.model.jnt_bodyid[j] == body]

    def place(
        self, body: int, pos: torch.Tensor, quat: torch.Tensor, values: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the poses of a body, (n, 3) and (n, 4), for n positions of its joints.

        Args:
            body: Id of the body.
            pos: Position of its parent, (3,).
            quat: Orientation of its parent, (4,).
            values: Positions of its joints (rad or m), (n, joints).
        """
        model, n = self.model, len(values)

        def rows(vector: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(vector.copy()).expand(n, -1)

        pos, quat = pos.expand(n, 3), quat.expand(n, 4)
        pos = pos + quat_apply(quat, rows(model.body_pos[body]))
        quat = quat_mul(quat, rows(model.body_quat[body]))
        for column, value in zip(self.joints_of(body), values.unbind(-1), strict=True):
            joint = self.joints[column]
            anchor, axis = rows(model.jnt_pos[joint]), rows(model.jnt_axis[joint])
            value = value - float(model.qpos0[model.jnt_qposadr[joint]])
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                pos = pos + quat_apply(quat, axis) * value.unsqueeze(-1)
                continue
            pos = pos + quat_apply(quat, anchor)
            quat = quat_mul(quat, quat_from_angle_axis(value, axis))
            pos = pos - quat_apply(quat, anchor)
        return pos, quat


@dataclass(frozen=True)
class _Order:
    """Columns of a file for the joints and bodies of the robot."""

    joints: tuple[int, ...]
    bodies: tuple[int, ...]
    w_last: bool = False
    """Quaternions are (x, y, z, w)."""


def arranged(
    path: str | Path, motion: Motion, skeleton: Skeleton, *, is_strict: bool = False
) -> Motion:
    """Return a motion with the joints and bodies of the robot in order.

    Columns are found by the names in the file, then by forward kinematics of a few frames; an order
    found by forward kinematics is a warning, and poses that no order explains are one.

    Args:
        path: Path of the file, for messages.
        motion: The motion.
        skeleton: The robot.
        is_strict: Raise for poses that no order explains.

    Raises:
        MotionFileError: fewer or more joints than the robot has; see also `is_strict`.
    """
    nj, nb = len(skeleton.joints), len(skeleton.bodies)
    num_bodies = motion.body_pos_w.shape[1]
    stored = _Order(tuple(range(nj)), tuple(range(min(nb, num_bodies))))
    named = replace(
        stored,
        joints=_columns(motion.joint_names, skeleton.joint_names) or stored.joints,
        bodies=_columns(motion.body_names, skeleton.body_names) or stored.bodies,
    )
    if motion.joint_pos.shape[1] != nj and named.joints == stored.joints:
        raise MotionFileError(
            f"Motion {path}: expected {nj} joints, got {motion.joint_pos.shape[1]}. The robot has "
            f"{list(skeleton.joint_names)}."
        )
    if not skeleton.is_comparable:
        return _reordered(motion, named)
    frames = _Frames(motion, skeleton)
    away, chord = frames.errors(named)
    if max(away, chord) <= _TOLERANCE:
        return _reordered(motion, named)
    order = frames.find_order()
    if order is None:
        if max(away, chord) <= _NOTABLE:
            return _reordered(motion, named)
        problem = (
            f"Motion {path}: bodies are up to {away:.3g} m and {4.0 * np.arcsin(chord / 2.0):.3g} rad "
            "from the forward kinematics of root and joints, and no other order explains them; "
            f"expected the joints {list(skeleton.joint_names)} and the bodies "
            f"{list(skeleton.body_names)} of the robot."
        )
        if is_strict:
            raise MotionFileError(problem)
        _warn(f"{problem} The motion is played as it is.")
        return _reordered(motion, named)
    moved = [sum(i != j for i, j in enumerate(columns)) for columns in (order.joints, order.bodies)]
    got = f"an order in which {moved[0]} joints and {moved[1]} bodies are elsewhere"
    if order == stored:
        got = "names of joints or bodies that are not in the order of the columns"
    quats = ", and quaternions (x, y, z, w)" if order.w_last else ""
    _warn(
        f"Motion {path}: expected the order of the robot, got {got}{quats}, by forward kinematics; the "
        "order of the poses is applied. Use `uv run mjlab csv-to-npz` to write the motion with names "
        "and in order."
    )
    return _reordered(motion, order)


def plausible(path: str | Path, recording: Recording, skeleton: Skeleton) -> Recording:
    """Return a recording in radians and in the order of the robot, as its joint limits tell.

    A recording without body poses has no other evidence. Angles in degrees, and joints that are within
    their limits in breadth-first or alphabetical order only, are converted with a warning; joints
    outside of their limits in any order are one warning.
    """
    model, ids = skeleton.model, np.array(skeleton.joints, dtype=int)
    limits = np.where(model.jnt_limited[ids, None] > 0, model.jnt_range[ids], (-np.inf, np.inf))
    turns = (model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_HINGE) & np.isfinite(limits).all(axis=1)

    def excess(joint_pos: np.ndarray) -> np.ndarray:
        return np.maximum(limits[:, 0] - joint_pos, joint_pos - limits[:, 1]).max(axis=0)

    joint_pos = recording.joint_pos
    if joint_pos.shape[1] != len(ids) or not (excess(joint_pos) > _OUTSIDE).any():
        return recording
    degrees = np.where(turns, np.deg2rad(joint_pos), joint_pos)
    if np.abs(joint_pos[:, turns]).max() > 2.0 * np.pi and (excess(degrees) < _WITHIN).all():
        _warn(f"{path}: expected joint angles in rad, got degrees by the joint limits; converted.")
        return replace(recording, joint_pos=degrees)
    depth = [_depth(model, int(model.jnt_bodyid[j])) for j in ids]
    orders = {
        "breadth-first": sorted(range(len(ids)), key=depth.__getitem__),
        "alphabetical": sorted(range(len(ids)), key=skeleton.joint_names.__getitem__),
    }
    fitting = {}
    for name, order in orders.items():
        reordered = joint_pos[:, np.argsort(order)]
        if (excess(reordered) < _WITHIN).all():
            fitting[name] = reordered
    if len(fitting) == 1:
        name, reordered = fitting.popitem()
        _warn(
            f"{path}: expected the joints in the order of the robot, got joints that are within their "
            f"limits in {name} order only, which is used. Name the columns in a header to select "
            "their order."
        )
        return replace(recording, joint_pos=reordered)
    outside = {
        n: round(float(e), 3) for n, e in zip(skeleton.joint_names, excess(joint_pos), strict=True)
    }
    _warn(
        f"{path}: expected joints within their limits, got these beyond (rad or m): "
        f"{ {n: e for n, e in outside.items() if e > _OUTSIDE} }; check order and unit of the columns."
    )
    return recording


def _depth(model: mujoco.MjModel, body: int) -> int:
    return 0 if body == 0 else 1 + _depth(model, model.body_parentid[body])


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)


def _columns(names: Sequence[str], wanted: Sequence[str]) -> tuple[int, ...]:
    """Return the columns of the names `wanted`, or () unless each is there once."""
    if any(names.count(name) != 1 for name in wanted):
        return ()
    return tuple(names.index(name) for name in wanted)


def _reordered(motion: Motion, order: _Order) -> Motion:
    changes: dict[str, Any] = {}
    for names, arrays, columns in (
        ("joint_names", PER_JOINT, list(order.joints)),
        ("body_names", PER_BODY, list(order.bodies)),
    ):
        if columns == list(range(getattr(motion, arrays[0]).shape[1])):
            continue
        changes |= {key: np.ascontiguousarray(getattr(motion, key)[:, columns]) for key in arrays}
        # Names that do not lead to this order are wrong.
        changes[names] = ()
    if order.w_last:
        changes["body_quat_w"] = np.ascontiguousarray(
            convert_quat(changes.get("body_quat_w", motion.body_quat_w), "wxyz")
        )
    return replace(motion, **changes) if changes else motion


class _Frames:
    """A few frames of a motion, that tell its joints apart, as float64 tensors."""

    def __init__(self, motion: Motion, skeleton: Skeleton) -> None:
        self.skeleton = skeleton
        arrays = (motion.joint_pos, motion.body_pos_w, motion.body_quat_w)
        finite = np.logical_and.reduce(
            [np.isfinite(array).all(axis=tuple(range(1, array.ndim))) for array in arrays]
        )
        joints, pos, quat = (array[finite].astype(np.float64) for array in arrays)
        if len(joints):
            # Frames in which a joint is farthest from its mean: joints that are equal in all other
            # frames differ there.
            telling = np.abs(joints - joints.mean(axis=0)).argmax(axis=0)
            spread = np.linspace(0, len(joints) - 1, _NUM_SPREAD).astype(int)
            telling = np.union1d(telling, spread)
            joints, pos, quat = joints[telling], pos[telling], quat[telling]
        self.joint_pos, self.pos, self.quat = (
            torch.from_numpy(array) for array in (joints, pos, quat)
        )

    def errors(self, order: _Order) -> tuple[float, float]:
        """Return the largest distance (m) and chord between file and forward kinematics."""
        model, bodies = self.skeleton.model, list(order.bodies)
        data, root = mujoco.MjData(model), model.body_jntadr[self.skeleton.bodies[0]]
        free = model.jnt_qposadr[root] + np.arange(7)
        joints = model.jnt_qposadr[np.array(self.skeleton.joints, dtype=int)]
        ids = list(self.skeleton.bodies[: len(bodies)])
        away = chord = 0.0
        for joint_pos, pos, quat in zip(
            self.joint_pos.numpy(),
            self.pos.numpy()[:, bodies],
            self.quats(order.w_last).numpy()[:, bodies],
            strict=True,
        ):
            data.qpos[free], data.qpos[joints] = [*pos[0], *quat[0]], joint_pos[list(order.joints)]
            mujoco.mj_kinematics(model, data)
            turns = [np.linalg.norm(data.xquat[ids] + sign * quat, axis=-1) for sign in (1, -1)]
            chord = max(chord, float(np.minimum(*turns).max()))
            away = max(away, float(np.linalg.norm(data.xpos[ids] - pos, axis=-1).max()))
        return away, chord

    def quats(self, w_last: bool) -> torch.Tensor:
        """Return the orientations (w, x, y, z) of the file, (F, bodies, 4)."""
        return convert_quat(self.quat, "wxyz") if w_last else self.quat

    def find_order(self) -> _Order | None:
        """Return the order that explains the poses; None without one."""
        if self.pos.shape[1] < len(self.skeleton.bodies) or not len(self.pos):
            return None
        for w_last, root in itertools.product((False, True), range(self.pos.shape[1])):
            order = self._follow(root, w_last)
            if order is not None and max(self.errors(order)) <= _TOLERANCE:
                return order
        return None

    def _follow(self, root: int, w_last: bool) -> _Order | None:
        """Find each body where its parent in the file and some of the joints left place it."""
        skeleton, quat = self.skeleton, self.quats(w_last)
        joints: dict[int, int] = {}
        bodies = {skeleton.bodies[0]: root}
        for body in skeleton.bodies[1:]:
            columns = skeleton.joints_of(body)
            joints_left = sorted(set(range(self.joint_pos.shape[1])) - set(joints.values()))
            bodies_left = sorted(set(range(self.pos.shape[1])) - set(bodies.values()))
            parent = bodies[skeleton.model.body_parentid[body]]
            choices = np.array(list(itertools.permutations(joints_left, len(columns))), dtype=int)
            # Largest errors of the choices so far, (choices, bodies left). Frames leave fewer.
            errors = torch.zeros(len(choices), len(bodies_left), dtype=torch.float64)
            for frame in range(len(self.pos)):
                pos, turn = skeleton.place(
                    body,
                    self.pos[frame, parent],
                    quat[frame, parent],
                    self.joint_pos[frame][choices],
                )
                there = quat[frame, bodies_left]
                chord = torch.minimum(torch.cdist(turn, there), torch.cdist(turn, -there))
                away = torch.cdist(pos, self.pos[frame, bodies_left])
                errors = errors.maximum(away).maximum(chord)
                fits = errors <= _TOLERANCE
                if not fits.any():
                    return None
                choices, errors = choices[fits.any(dim=1).numpy()], errors[fits.any(dim=1)]
                if fits.sum() == 1:
                    break
            # Joints that move alike stay in their columns.
            errors[torch.from_numpy((choices == columns).all(axis=1))] -= _ALIKE
            choice, found = divmod(int(errors.argmin()), len(bodies_left))
            bodies[body] = bodies_left[found]
            joints |= dict(zip(columns, choices[choice].tolist(), strict=True))
        return _Order(
            tuple(joints[i] for i in range(len(skeleton.joints))),
            tuple(bodies[body] for body in skeleton.bodies),
            w_last,
        )
