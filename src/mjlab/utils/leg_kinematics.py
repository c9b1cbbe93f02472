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

# Range and number of nodes of alpha and beta in a table; range of bend, which crouched legs extend, and
# distance of its nodes (rad).
_ALPHA, _BETA = (-0.8, 0.8, 13), (-0.6, 0.6, 9)
_BEND, _BEND_STEP = (0.05, 1.0), 0.14
# Share of a leg's largest bend in a table: at the end of the knee's range, the hips would turn instead.
_BENT = 0.95
# Smallest distance of hip and ankle, as a share of their largest: the angles of a leg are undefined at 0.
_SHORTEST = 0.2
# Angle of the knee from straight at which the search starts (rad): a straight leg is singular.
_BENT_KNEE = 0.6
# Largest distance of the ankle from its place (m), with all joints inside their ranges, and the part of a
# table in which it counts: largest alpha and beta, and smallest bend (rad). Legs with a hip's axes apart do
# not reach all places beyond it.
_MISS, _WALK = 0.02, (0.55, 0.35, 0.15)
# Distance from the end of a joint's range that counts as at the end (rad).
_AT_END = 0.02
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
        label: Leg in messages, by its sole.
        joints: Ids of the joints, hip first.
        knee: Index of the knee in `joints`.
        yaw: Index of the joint that turns the leg about the vertical; None without one.
        ranges: Lowest and highest positions of the joints (rad), (2, J): infinite without limits, and for the
            knee on the side of straight on which it is bent.
        axes: Axes of the joints in the default pose, in the frame of the root, (J, 3).
        bend: Bend in the default pose (rad).
        beta: Angle to the left in the default pose (rad).
        largest_bend: Bend at the end of the knee's range (rad).
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
        self.label = f"leg of {model.site(sole).name!r}"
        names = [model.joint(j).name for j in joints]
        if not joints or any(model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_HINGE):
            raise ValueError(f"{self.label}: expected hinges, got joints {names}.")
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
                f"{self.label}: expected a knee between hip and sole, got joints {names} with axes at distances "
                f"{nearest.round(3).tolist()} m from both."
            )
        above, below = slice(self.knee), slice(self.knee + 1, None)
        self.yaw = turning_joint(self.axes[above])
        self.hip = _nearest_point(self._anchors[above], self.axes[above], self._anchors[0])
        self._ankle = _nearest_point(self._anchors[below], self.axes[below], self.sole)
        turn, position = data.xmat[self.foot].reshape(3, 3), data.xpos[self.foot]
        self.ankle = (frame @ self._ankle + origin - position) @ turn
        self._home = data.qpos[model.jnt_qposadr[joints]]
        is_limited = model.jnt_limited[joints].astype(bool)[:, None]
        self.ranges = np.where(is_limited, model.jnt_range[joints], (-np.inf, np.inf)).T
        self._sweep_knee()
        offset = self._ankle - self.hip
        self.bend = float(np.arccos(min(np.linalg.norm(offset) / self.length, 1.0)))
        self.beta = float(np.arctan2(offset[1], np.hypot(offset[0], offset[2])))

    def _sweep_knee(self) -> None:
        """Set length, largest bend and range of the knee, and the joint positions where the search starts."""
        knee, home = self.knee, self._home[self.knee]
        low, high = self.ranges[:, knee].clip(-np.pi, np.pi)
        swept = np.tile(self._home, (500, 1))
        swept[:, knee] = np.linspace(low, high, 500)
        distance = np.linalg.norm(self.forward(swept).ankle - self.hip, axis=1)
        self.length, straight = float(distance.max()), float(swept[distance.argmax(), knee])
        is_bent = abs(home - straight) > _BEND[0]
        side = 1.0 if (home > straight if is_bent else high - straight > straight - low) else -1.0
        self.ranges[int(side < 0.0), knee] = straight
        shortest = distance[side * (swept[:, knee] - straight) >= 0.0].min() / self.length
        self.largest_bend = float(np.arccos(max(shortest, _SHORTEST)))
        self._start = self._home.copy()
        self._start[knee] = straight + side * max(side * (home - straight), _BENT_KNEE)
        self._start = self._start.clip(*self.ranges)

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
        damping is half of the squared error (Sugihara, IEEE Transactions on Robotics 27(5), 2011). Joints
        stay in their ranges. Ankles are clipped at last: within ranges, hips would turn for a level sole,
        by 0.6 rad on the Berkeley Humanoid.
        """
        ranges = self.ranges.copy()
        ranges[:, self.knee + 1 :] = [[-np.inf], [np.inf]]
        positions = np.tile(self._start, (len(ankle), 1))
        for _ in range(_ITERATIONS):
            pose = self.forward(positions)
            up = pose.sole[:, :, 2]
            level = np.stack((up[:, 1], -up[:, 0]), axis=1)
            error = np.concatenate(((ankle - pose.ankle) / self.length, _LEVEL * level), axis=1)
            levers = np.cross(pose.axes, pose.ankle[:, None] - pose.anchors) / self.length
            jacobian = np.concatenate((levers, _LEVEL * pose.axes[:, :, :2]), axis=2)  # (P, J, 5)
            if self.yaw is not None:
                jacobian[:, self.yaw] = 0.0
            step = _damped_step(jacobian, error)
            # Joints that stop at the end of their ranges move there, and the others without them.
            stops = (positions + step).clip(*ranges) != positions + step
            jacobian[stops] = 0.0
            step = np.where(stops, step, _damped_step(jacobian, error))
            positions = (positions + step).clip(*ranges)
        return positions.clip(*self.ranges)

    def is_inside(self, positions: np.ndarray) -> np.ndarray:
        """Return where all joints are inside their ranges, not at an end, as (P,)."""
        low, high = self.ranges
        return np.all((positions > low + _AT_END) & (positions < high - _AT_END), axis=1)


class LegTable:
    """Joint positions of a leg by alpha, beta and bend, interpolated linearly, and clamped to its range."""

    def __init__(self, leg: Leg, device: str, lift: float = 0.5) -> None:
        """Solve the inverse kinematics at the nodes of the table.

        Args:
            leg: Leg.
            device: Device of the table.
            lift: Bend beyond that of the default pose (rad), as far as the knee bends.

        Raises:
            ValueError: the ankle misses a place by more than 2 cm, with all joints inside their ranges.
        """
        deepest = max(leg.bend, _BENT * leg.largest_bend)
        low, high = _BEND[0], min(max(leg.bend + lift, _BEND[1]), deepest)
        bends = (low, high, 2 + int((high - low) / _BEND_STEP))
        ranges = (_ALPHA, _BETA, bends)
        nodes = np.meshgrid(*(np.linspace(*r) for r in ranges), indexing="ij")
        wanted = leg.place(*(node.ravel() for node in nodes))
        found = leg.reach(wanted)
        alpha, beta, bend = (node.ravel() for node in nodes)
        counts = (np.abs(alpha) < _WALK[0]) & (np.abs(beta) < _WALK[1]) & (bend > _WALK[2])
        counts &= leg.is_inside(found)
        miss = np.linalg.norm(leg.forward(found).ankle - wanted, axis=1) * counts
        if miss.max() > _MISS:
            where = [round(float(node.flat[miss.argmax()]), 2) for node in nodes]
            raise ValueError(
                f"{leg.label}: expected joints that bring the ankle to its place, got a miss of "
                f"{100.0 * miss.max():.1f} cm at alpha, beta and bend {where} rad."
            )
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


def turning_joint(axes: np.ndarray) -> int | None:
    """Return the joint that turns a leg about the vertical, by its index in `axes`; None without one.

    Args:
        axes: Axes of the joints above the knee in the default pose, z up, (J, 3).
    """
    vertical = np.abs(axes[:, 2])
    return int(vertical.argmax()) if vertical.max(initial=0.0) > _VERTICAL else None


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


def _damped_step(jacobian: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the step of joints (rad), (P, J), by Jacobian, (P, J, 5), and error, (P, 5)."""
    damping = 0.5 * np.square(error).sum(axis=1) + _DAMPING
    square = jacobian.swapaxes(1, 2) @ jacobian + damping[:, None, None] * np.eye(5)
    step = (jacobian @ np.linalg.solve(square, error[..., None]))[..., 0]
    return step * (_LARGEST_STEP / np.abs(step).max(axis=1, keepdims=True).clip(_LARGEST_STEP))


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
