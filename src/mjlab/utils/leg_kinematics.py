"""Inverse kinematics of legs of any joint order, from their axes: a table of joint positions.

A leg is a chain of hinges: hips, a knee, and ankles if it has some. Places of the foot are given by

    alpha, beta    angles of the line from hip to ankle (rad), forward and to the left
    bend           bend b of the leg (rad): hip and ankle are L cos(b) apart, L apart with a straight knee

in the frame of the root, with the sole as level as in the default pose. A leg without ankles ends at its
sole. The joint that turns the leg about the vertical, if there is one, stays at its default position.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import torch

# Range and number of nodes of alpha, beta and bend in a table.
_ALPHA, _BETA, _BEND = (-0.8, 0.8, 13), (-0.6, 0.6, 9), (0.05, 1.0, 8)
# Weight of the sole's tilt (1/rad) beside that of the ankle's position (1 / leg length): a leg of fewer than
# five joints reaches the position within 0.3 % of its length, and stays as level as it can.
_LEVEL = 0.05
_ITERATIONS, _LARGEST_STEP, _DAMPING = 20, 0.5, 1e-7
# Distance of the knee's axis from hip and sole, as a share of their distance: 0.44 on the G1.
_MIN_KNEE = 0.25
# Cosine between the vertical and the axis of the joint that turns a leg.
_VERTICAL = 0.8


class LegPose(NamedTuple):
    """Poses of a leg, P of them, in the frame of the root."""

    ankle: np.ndarray
    """Position of the ankle (m), (P, 3)."""
    sole: np.ndarray
    """Rotation of the sole from the default pose, (P, 3, 3)."""
    axes: np.ndarray
    """Axes of the joints, (P, J, 3)."""
    anchors: np.ndarray
    """Anchors of the joints (m), (P, J, 3)."""


class Leg:
    """A leg of a biped.

    Attributes:
        joints: Ids of the joints, hip first.
        knee: Index of the knee in `joints`.
        yaw: Index of the joint that turns the leg about the vertical; None without one.
        axes: Axes of the joints in the default pose, in the frame of the root, (J, 3).
        bend: Bend in the default pose (rad).
        length: Largest distance L from hip to ankle, over the range of the knee (m).
        hip: Center of the hip's axes in the frame of the root (m), (3,).
        foot: Id of the foot's body.
        ankle: Center of the ankle's axes in the frame of the foot's body (m), (3,).
        sole: Position of the sole in the frame of the root (m), (3,).
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, root: int, joints: list[int], sole: int
    ) -> None:
        """Read a leg.

        Args:
            model: Model.
            data: Default pose.
            root: Body whose frame counts.
            joints: Ids of the joints from the root to the foot.
            sole: Id of the site in the sole.

        Raises:
            ValueError: a joint is no hinge, or none is a knee.
        """
        self.joints, self.foot = joints, int(model.site_bodyid[sole])
        label, names = f"leg of {model.site(sole).name!r}", [model.joint(j).name for j in joints]
        if not joints or any(model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_HINGE):
            raise ValueError(f"{label}: expected hinges, got joints {names}.")
        frame, origin = data.xmat[root].reshape(3, 3), data.xpos[root]
        self.axes = data.xaxis[joints] @ frame
        self._anchors = (data.xanchor[joints] - origin) @ frame
        self.sole = (data.site_xpos[sole] - origin) @ frame
        # The knee is far from both ends.
        ends = (self._anchors[0], self.sole)
        nearest = np.min([_distances(end, self._anchors, self.axes) for end in ends], axis=0)
        self.knee = int(nearest.argmax())
        if nearest[self.knee] < _MIN_KNEE * np.linalg.norm(self.sole - self._anchors[0]):
            raise ValueError(
                f"{label}: expected a knee between hip and sole, got joints {names} with axes at distances "
                f"{nearest.round(3).tolist()} m from both."
            )
        above, below = slice(self.knee), slice(self.knee + 1, None)
        vertical = np.abs(self.axes[above, 2])
        self.yaw = int(vertical.argmax()) if vertical.max(initial=0.0) > _VERTICAL else None
        self.hip = _nearest_point(self._anchors[above], self.axes[above], self._anchors[0])
        self._ankle = _nearest_point(self._anchors[below], self.axes[below], self.sole)
        turn, position = data.xmat[self.foot].reshape(3, 3), data.xpos[self.foot]
        self.ankle = (frame @ self._ankle + origin - position) @ turn
        self._home = data.qpos[model.jnt_qposadr[joints]]
        swept = np.tile(self._home, (100, 1))
        is_limited = bool(model.jnt_limited[joints[self.knee]])
        limits = model.jnt_range[joints[self.knee]] if is_limited else (-np.pi, np.pi)
        swept[:, self.knee] = np.linspace(*limits, 100)
        self.length = float(np.linalg.norm(self.forward(swept).ankle - self.hip, axis=1).max())
        distance = float(np.linalg.norm(self._ankle - self.hip))
        self.bend = float(np.arccos(min(distance / self.length, 1.0)))

    def forward(self, positions: np.ndarray) -> LegPose:
        """Return the poses of joint positions (rad), (P, J)."""
        rotation, origin = np.tile(np.eye(3), (len(positions), 1, 1)), np.zeros((len(positions), 3))
        axes, anchors = [], []
        for axis, anchor, angle in zip(
            self.axes, self._anchors, (positions - self._home).T, strict=True
        ):
            axes.append(rotation @ axis)
            anchors.append(origin + rotation @ anchor)
            rotation = rotation @ _turns(axis, angle)
            origin = anchors[-1] - rotation @ anchor
        ankle = origin + rotation @ self._ankle
        return LegPose(ankle, rotation, np.stack(axes, axis=1), np.stack(anchors, axis=1))

    def place(self, alpha: np.ndarray, beta: np.ndarray, bend: np.ndarray) -> np.ndarray:
        """Return the position of the ankle of angles and bends (rad), (P,) each, as (P, 3)."""
        along = (np.sin(alpha) * np.cos(beta), np.sin(beta), -np.cos(alpha) * np.cos(beta))
        return self.hip + self.length * np.cos(bend)[:, None] * np.stack(along, axis=1)

    def reach(self, ankle: np.ndarray) -> np.ndarray:
        """Return the joint positions (rad) that bring the ankle to (P, 3), as (P, J).

        Damped least squares on the position of the ankle and, with less weight, the tilt of the sole. The
        damping is half of the squared error (Sugihara, IEEE Transactions on Robotics 27(5), 2011).
        """
        positions = np.tile(self._home, (len(ankle), 1))
        for _ in range(_ITERATIONS):
            pose = self.forward(positions)
            up = pose.sole[:, :, 2]
            level = np.stack((up[:, 1], -up[:, 0]), axis=1)
            error = np.concatenate(((ankle - pose.ankle) / self.length, _LEVEL * level), axis=1)
            levers = np.cross(pose.axes, pose.ankle[:, None] - pose.anchors) / self.length
            jacobian = np.concatenate((levers, _LEVEL * pose.axes[:, :, :2]), axis=2)  # (P, J, 5)
            if self.yaw is not None:
                jacobian[:, self.yaw] = 0.0
            damping = 0.5 * np.square(error).sum(axis=1) + _DAMPING
            square = jacobian.swapaxes(1, 2) @ jacobian + damping[:, None, None] * np.eye(5)
            step = (jacobian @ np.linalg.solve(square, error[..., None]))[..., 0]
            step *= np.minimum(1.0, _LARGEST_STEP / np.abs(step).max(axis=1, keepdims=True))
            positions += step
        return positions


class LegTable:
    """Joint positions of a leg by alpha, beta and bend, interpolated linearly, and clamped to its range."""

    def __init__(self, leg: Leg, device: str) -> None:
        """Solve the inverse kinematics at the nodes of the table."""
        ranges = (_ALPHA, _BETA, _BEND)
        nodes = np.meshgrid(*(np.linspace(*r) for r in ranges), indexing="ij")
        found = leg.reach(leg.place(*(node.ravel() for node in nodes)))
        # As an image, (1, channel, depth, height, width): (1, J, alpha, beta, bend).
        table = torch.tensor(found.T.reshape(1, -1, *nodes[0].shape), dtype=torch.float32)
        self._table = table.to(device)
        low, high, _ = torch.tensor(ranges, dtype=torch.float32, device=device).T
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)

    def __call__(self, place: torch.Tensor) -> torch.Tensor:
        """Return the joint positions (rad) of places (alpha, beta, bend), (N, 3), as (N, J)."""
        # Coordinates in an image are (x, y, z) in [-1, 1]: width first.
        where = ((place - self._middle) / self._half).flip(1)[None, :, None, None]
        found = torch.nn.functional.grid_sample(
            self._table, where, padding_mode="border", align_corners=True
        )
        return found[0, :, :, 0, 0].T


def find_legs(
    model: mujoco.MjModel, data: mujoco.MjData, root: int, soles: list[int]
) -> tuple[Leg, Leg]:
    """Return the left and the right leg of a biped.

    Joints that carry both feet, such as a waist's, are no part of a leg.

    Args:
        model: Model.
        data: Default pose.
        root: Body of the robot's root.
        soles: Ids of the sites in the soles.

    Raises:
        ValueError: not two soles, or a leg that is not supported.
    """
    if len(soles) != 2:
        raise ValueError(f"feet: expected the sites of two feet, got {len(soles)}.")
    chains = [_joints_above(model, root, int(model.site_bodyid[sole])) for sole in soles]
    shared = set(chains[0]) & set(chains[1])
    first, second = (
        Leg(model, data, root, [j for j in chain if j not in shared], sole)
        for chain, sole in zip(chains, soles, strict=True)
    )
    return (first, second) if first.sole[1] > second.sole[1] else (second, first)


def _joints_above(model: mujoco.MjModel, root: int, body: int) -> list[int]:
    """Return the joints below `root` that move `body`, the first one first."""
    joints: list[int] = []
    while body not in (0, root):
        first = int(model.body_jntadr[body])
        joints = [*range(first, first + int(model.body_jntnum[body])), *joints]
        body = int(model.body_parentid[body])
    return joints


def _turns(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return rotations about a unit axis, (3,), by angles (rad), (P,): I + sin K + (1 - cos) K^2."""
    skew = np.cross(np.eye(3), axis)
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * skew + (1.0 - cosine) * (skew @ skew)


def _distances(point: np.ndarray, anchors: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the distances of a point, (3,), from axes, (J,)."""
    return np.linalg.norm(np.cross(point - anchors, axes), axis=1)


def _nearest_point(anchors: np.ndarray, axes: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the point with the least sum of squared distances to axes; of several, that closest to `near`."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None]  # (J, 3, 3)
    offset = np.einsum("jab,jb->a", across, anchors - near)
    return near + np.linalg.lstsq(across.sum(axis=0), offset, rcond=1e-3)[0]
