"""Make the bundled motions by inverse kinematics, from the descriptions below.

    uv run --group dev python tools/make_motions.py

A description lists steps, pelvis drop, trunk lean and joint angles. Computed from it, in this order:

1. the feet: stationary on the ground, or swinging on a smooth arc to the next foothold;
2. the center of pressure p: midway between the feet at the start and at the end, at the stance foot
   during swings, and moving from one foot to the other in double support;
3. the center of mass c, from the linear inverted pendulum, c - (h / g) c'' = p, with c at rest at both
   ends: so p, the ground reaction point, stays within the soles;
4. the joints: `mink` solves for the poses of the feet and the center of mass, with an upright trunk
   and the rest near the described posture, within the soft limits.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from scipy.linalg import solve_banded

from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.tasks.tracking.motion_file import Motion, write_motion
from mjlab.tasks.tracking.motion_recording import Recording, make_motion
from mjlab.tasks.tracking.motion_sources import SHIPPED

FPS = 50.0
_GRAVITY = 9.81
_FEET = ("left", "right")
# Center of a sole, and its height, in the frame of its body (m).
_SOLE_CENTRE = 0.035
_SOLE_BELOW_ANKLE = 0.035
# Height of the pelvis with slightly bent knees.
_PELVIS_HEIGHT = 0.735
# Further digits are noise to a controller, and most of a compressed file.
_ROUNDING = {"body_pos_w": 2.0**-17, "body_quat_w": 2.0**-17, "joint_pos": 2.0**-17}
_VELOCITY_ROUNDING = 2.0**-13


@dataclass(frozen=True)
class Key:
    """Keyframe of the body; motion between two keys is smooth."""

    time: float
    """Seconds from the start."""
    drop: float = 0.0
    """Drop of the pelvis (m)."""
    lean: float = 0.0
    """Forward lean of the trunk (rad)."""
    joints: dict[str, float] = field(default_factory=dict)
    """Joint angles (rad); other joints keep the default pose."""


@dataclass(frozen=True)
class Step:
    """One step, in the heading frame of the robot."""

    foot: Literal["left", "right"]
    forward: float = 0.0
    """Displacement of the foot (m)."""
    left: float = 0.0
    turn: float = 0.0
    """Rotation of the foot to the left, about the robot's start position (rad)."""


@dataclass(frozen=True)
class Description:
    """Description of a motion."""

    name: str
    seconds: float
    """Duration without steps (s)."""
    keys: tuple[Key, ...] = (Key(0.0),)
    steps: tuple[Step, ...] = ()
    swing_s: float = 0.8
    """Swing time (s)."""
    shift_s: float = 0.9
    """Double-support time between steps (s)."""
    lift: float = 0.05
    """Height of the swing arc (m)."""
    stance: float = 0.11
    """Initial lateral distance of each foot from the center (m)."""


def _wave() -> tuple[Key, ...]:
    """Raise the right arm, wave three times, and lower it."""
    raised = {
        "right_shoulder_pitch_joint": 0.0,
        "right_shoulder_roll_joint": -1.3,
        "right_shoulder_yaw_joint": -1.2,
        "right_elbow_joint": -0.15,
    }
    keys = [Key(0.0), Key(0.2), Key(1.3, joints=raised)]
    for i in range(6):
        side = {"right_elbow_joint": 0.25 if i % 2 == 0 else -0.55}
        keys.append(Key(1.65 + 0.35 * i, joints={**raised, **side}))
    return (*keys, Key(3.75, joints=raised), Key(4.9), Key(5.2))


_ARMS_FORWARD = {
    f"{side}_{joint}_joint": angle * sign
    for side, mirror in (("left", 1.0), ("right", -1.0))
    for joint, angle, sign in (
        ("shoulder_pitch", -0.9, 1.0),
        ("shoulder_roll", 0.15, mirror),
        ("elbow", 0.6, 1.0),
    )
}
_SQUATTED = {"drop": 0.24, "lean": 0.3, "joints": _ARMS_FORWARD}
_TURN = math.radians(30.0)

DESCRIPTIONS = (
    Description(
        "squat",
        seconds=4.4,
        keys=(Key(0.0), Key(0.2), Key(1.9, **_SQUATTED), Key(2.4, **_SQUATTED), Key(4.1), Key(4.4)),
    ),
    Description("wave", seconds=5.2, keys=_wave()),
    # Narrow stance: the ankle roll limit of 13° allows no wider one.
    Description(
        "side_step",
        seconds=0.0,
        steps=(Step("left", left=0.06), Step("right", left=0.06)) * 2,
        swing_s=0.6,
        shift_s=0.9,
        stance=0.09,
    ),
    Description(
        "turn_in_place",
        seconds=0.0,
        steps=(Step("left", turn=_TURN), Step("right", turn=_TURN)) * 2,
        swing_s=0.6,
        shift_s=0.9,
    ),
    Description(
        "slow_walk",
        seconds=0.0,
        steps=(
            Step("left", forward=0.14),
            Step("right", forward=0.28),
            Step("left", forward=0.28),
            Step("right", forward=0.14),
        ),
        swing_s=0.7,
        shift_s=0.9,
    ),
)


@dataclass(frozen=True)
class _Plan:
    """Trajectories of feet and center of pressure."""

    times: np.ndarray
    """Times, (T,)."""
    feet: dict[str, np.ndarray]
    """For each foot (T, 4): x, y, height of the sole, yaw."""
    pressure: np.ndarray
    """Center of pressure, (T, 2)."""


def _smooth(share: np.ndarray) -> np.ndarray:
    """Return the minimum-jerk profile from 0 to 1, at rest at both ends."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def _plan(description: Description) -> _Plan:
    """Schedule the steps."""
    # The center of mass starts before the center of pressure, and comes to rest after it.
    rest = 0.5
    period = description.shift_s + description.swing_s
    steps = description.steps
    seconds = description.seconds
    if steps:
        seconds = 2.0 * rest + len(steps) * period + description.shift_s
    times = np.arange(round(seconds * FPS) + 1) / FPS
    sides = {"left": description.stance, "right": -description.stance}
    pose = {foot: np.array([0.0, sides[foot], 0.0, 0.0]) for foot in _FEET}
    feet = {foot: np.tile(pose[foot], (len(times), 1)) for foot in _FEET}
    pressure = np.tile(_middle(pose), (len(times), 1))
    last = pressure[0]
    for number, step in enumerate(steps):
        begin = rest + number * period
        lift_off = begin + description.shift_s
        standing = _centre(pose["right" if step.foot == "left" else "left"])
        _go(pressure, times, begin, lift_off, last, standing)
        target = _stepped(pose[step.foot], step)
        phase = np.clip((times - lift_off) / description.swing_s, 0.0, 1.0)
        in_air = times > lift_off
        feet[step.foot][in_air] = _swing(pose[step.foot], target, phase, description.lift)[in_air]
        pose[step.foot], last = target, standing
    if steps:
        end = rest + len(steps) * period
        _go(pressure, times, end, end + description.shift_s, last, _middle(pose))
    return _Plan(times, feet, pressure)


def _swing(start: np.ndarray, end: np.ndarray, phase: np.ndarray, lift: float) -> np.ndarray:
    """Return a swing foot at phases from 0 to 1: up, over, and down, with ground clearance."""
    over = _smooth((phase - 0.15) / 0.7)[:, None]
    poses = start + over * (end - start)
    poses[:, 2] = lift * np.minimum(_smooth(phase / 0.4), _smooth((1.0 - phase) / 0.4))
    return poses


def _go(
    values: np.ndarray, times: np.ndarray, begin: float, end: float, start: Any, goal: Any
) -> None:
    """Move `values` from `start` to `goal` between two times, constant afterwards."""
    share = _smooth((times - begin) / (end - begin))[:, None]
    moved = times >= begin
    values[moved] = (start + share * (goal - start))[moved]


def _centre(pose: np.ndarray) -> np.ndarray:
    """Return the center of the sole of a foot at x, y, height, yaw."""
    x, y, _, yaw = pose
    return np.array([x + _SOLE_CENTRE * math.cos(yaw), y + _SOLE_CENTRE * math.sin(yaw)])


def _middle(pose: dict[str, np.ndarray]) -> np.ndarray:
    return 0.5 * (_centre(pose["left"]) + _centre(pose["right"]))


def _stepped(pose: np.ndarray, step: Step) -> np.ndarray:
    """Return x, y, height, yaw of a foot after a step."""
    x, y, _, yaw = pose
    x += step.forward * math.cos(yaw) - step.left * math.sin(yaw)
    y += step.forward * math.sin(yaw) + step.left * math.cos(yaw)
    cos, sin = math.cos(step.turn), math.sin(step.turn)
    return np.array([cos * x - sin * y, sin * x + cos * y, 0.0, yaw + step.turn])


def _centre_of_mass(pressure: np.ndarray, height: float) -> np.ndarray:
    """Return c (T, 2) with c - (h / g) c'' = p, starting and ending at rest on p."""
    count = len(pressure)
    stiffness = height / _GRAVITY * FPS**2
    bands = np.zeros((3, count))
    bands[0, 2:] = bands[2, :-2] = -stiffness
    bands[1] = 1.0 + 2.0 * stiffness
    bands[1, 0] = bands[1, -1] = 1.0
    return solve_banded((1, 1), bands, pressure)


class _Body:
    """Interpolation of the keys of a description."""

    def __init__(self, keys: tuple[Key, ...], default: dict[str, float]) -> None:
        self._times = np.array([key.time for key in keys])
        self._names = sorted({name for key in keys for name in key.joints})
        self._values = np.array(
            [
                [key.drop, key.lean, *(key.joints.get(n, default[n]) for n in self._names)]
                for key in keys
            ]
        )

    def at(self, time: float) -> tuple[float, float, dict[str, float]]:
        """Return drop, lean and joint angles."""
        last = len(self._times) - 1
        i = min(max(int(np.searchsorted(self._times, time, side="right")) - 1, 0), last)
        values = self._values[i]
        if i < last:
            share = _smooth(
                np.array((time - self._times[i]) / (self._times[i + 1] - self._times[i]))
            )
            values = values + share * (self._values[i + 1] - values)
        return values[0], values[1], dict(zip(self._names, values[2:].tolist(), strict=True))


class _Solver:
    """Inverse kinematics of a frame, starting from the previous frame."""

    def __init__(self, model: mujoco.MjModel, qpos: np.ndarray) -> None:
        import mink

        self._mink = mink
        self.model = model
        self.configuration = mink.Configuration(model, qpos)
        self._feet = {
            foot: mink.FrameTask(f"{foot}_ankle_roll_link", "body", 20.0, 10.0) for foot in _FEET
        }
        self._com = mink.ComTask(cost=np.array([10.0, 10.0, 0.0]))
        self._pelvis = mink.FrameTask("pelvis", "body", np.array([0.0, 0.0, 5.0]), 1.0)
        self._torso = mink.FrameTask("torso_link", "body", 0.0, 2.0)
        cost = np.full(model.nv, 0.02)
        for name in ("shoulder", "elbow", "wrist", "waist"):
            for joint in range(1, model.njnt):
                if name in model.joint(joint).name:
                    cost[model.jnt_dofadr[joint]] = 1.0
        cost[:6] = 0.0
        self._posture = mink.PostureTask(model, cost)
        self._limits = [mink.ConfigurationLimit(model)]
        self._default = qpos.copy()

    def solve(
        self,
        feet: dict[str, np.ndarray],
        com: np.ndarray,
        pelvis_height: float,
        lean: float,
        joints: dict[str, float],
    ) -> np.ndarray:
        """Return qpos for target feet (x, y, height of the sole, yaw) and posture."""
        mink = self._mink
        for foot, (x, y, height, yaw) in feet.items():
            self._feet[foot].set_target(_pose(mink, (x, y, height + _SOLE_BELOW_ANKLE), yaw))
        self._com.set_target(np.array([*com, 0.0]))
        yaw = 0.5 * (feet["left"][3] + feet["right"][3])
        self._pelvis.set_target(_pose(mink, (0.0, 0.0, pelvis_height), yaw, 0.5 * lean))
        self._torso.set_target(_pose(mink, (0.0, 0.0, 0.0), yaw, lean))
        target = self._default.copy()
        for name, angle in joints.items():
            target[self.model.joint(name).qposadr[0]] = angle
        self._posture.set_target(target)
        tasks = [*self._feet.values(), self._com, self._pelvis, self._torso, self._posture]
        for _ in range(40):
            velocity = mink.solve_ik(
                self.configuration, tasks, 1.0, "daqp", damping=1e-4, limits=self._limits
            )
            self.configuration.integrate_inplace(velocity, 1.0)
            if np.abs(velocity).max() < 1e-6:
                break
        return self.configuration.q.copy()


def _pose(mink: Any, position: Any, yaw: float, pitch: float = 0.0) -> Any:
    rotation = mink.SO3.from_z_radians(yaw) @ mink.SO3.from_y_radians(pitch)
    return mink.SE3.from_rotation_and_translation(rotation, np.array(position))


def make(description: Description) -> Motion:
    """Return the motion of a description."""
    entity = get_g1_robot_cfg().build()
    model = entity.compile()
    _shrink_to_soft_limits(model, 0.9)
    qpos = model.key_qpos[0].copy()
    plan = _plan(description)
    default = {model.joint(i).name: float(qpos[model.jnt_qposadr[i]]) for i in range(1, model.njnt)}
    solver, body = _Solver(model, qpos), _Body(description.keys, default)
    height = _com_height(model, qpos)
    com = _centre_of_mass(plan.pressure, height)
    poses = []
    for t, time in enumerate(plan.times):
        drop, lean, joints = body.at(float(time))
        feet = {foot: plan.feet[foot][t] for foot in _FEET}
        poses.append(solver.solve(feet, com[t], _PELVIS_HEIGHT - drop, lean, joints))
    states = np.stack(poses)
    recording = Recording(
        fps=FPS, root_pos=states[:, :3], root_quat=states[:, 3:7], joint_pos=states[:, 7:]
    )
    return _rounded(make_motion(recording, model, entity.joint_names, entity.body_names))


def _com_height(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return float(data.subtree_com[0, 2])


def _shrink_to_soft_limits(model: mujoco.MjModel, factor: float) -> None:
    middle = model.jnt_range.mean(axis=1, keepdims=True)
    model.jnt_range[:] = middle + factor * (model.jnt_range - middle)


def _rounded(motion: Motion) -> Motion:
    values = {name: getattr(motion, name) for name in motion.__dataclass_fields__}
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            unit = _ROUNDING.get(name, _VELOCITY_ROUNDING)
            values[name] = (np.round(value / unit) * unit).astype(np.float32)
    return Motion(**values)


def main() -> None:
    """Write all motions, or those given on the command line."""
    parser = argparse.ArgumentParser(description="Make the motions that ship with the package.")
    parser.add_argument("names", nargs="*", help="motions to make; all if none is named")
    parser.add_argument("--folder", type=Path, default=SHIPPED)
    arguments = parser.parse_args()
    for description in DESCRIPTIONS:
        if not arguments.names or description.name in arguments.names:
            path = write_motion(arguments.folder / description.name, make(description))
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
