"""Drives with hidden parameters, recovered by `fit-actuators` from logs of a leg."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.identification.estimate import LimbEstimate
from mjlab.identification.limb import build_limb, hang
from mjlab.identification.log import JointLog
from mjlab.identification.plant import KINDS
from mjlab.identification.robot import Drives, fit_robot

# Position about which they move (rad), and effort limit (N m). Joints without a log are held at 0.
JOINTS = {
    "FR_hip_joint": (0.0, 23.7),
    "FR_thigh_joint": (0.9, 23.7),
    "FR_calf_joint": (-1.8, 35.55),
}
AMPLITUDE = 0.25
SECONDS, RATE = 12.0, 500
PHYSICS = 0.0005
RANGES = {
    "armature": (0.004, 0.015),
    "damping": (0.1, 0.4),
    "friction": (0.2, 0.8),
    "kp": (25.0, 50.0),
    "kd": (0.5, 1.5),
}
DELAY = (0.003, 0.015)
# Friction of the hidden robot: Stribeck's, from `REST` times the value at rest to the value in motion.
REST, REST_SPEED = (1.15, 1.4), (0.03, 0.1)
# Of measurements: standard deviation, and step of the digits.
POSITION, VELOCITY, TORQUE = (5e-4, 2 * np.pi / 2**14), (0.05, 0.01), (0.1, 0.05)
WIDTH, DELAY_WIDTH = 0.15, 0.002


@dataclass(frozen=True)
class Trial:
    """A log, and the parameters that made it."""

    log: JointLog
    true: dict[str, np.ndarray]
    """Parameters by kind, (J,)."""
    delay: float


def targets(rng: np.random.Generator, centers: list[float]) -> np.ndarray:
    """Return the motion of `docs/how-to/fit_actuators.md` about some positions, (T, J).

    Half of the time chirps of 0.2 to 8 Hz, every second joint from fast to slow; a quarter steps; the
    rest slow triangles.
    """
    time = np.arange(round(SECONDS * RATE)) / RATE
    still, chirp, steps = 0.5, 0.5 * SECONDS, 0.25 * SECONDS
    slow, fast, every = 0.2, 8.0, 0.35
    growth = np.log(fast / slow) / chirp
    columns = []
    for joint, center in enumerate(centers):
        t = np.clip(time - still, 0.0, chirp)
        if joint % 2:
            phase = 2 * np.pi * fast * (1.0 - np.exp(-growth * t)) / growth
        else:
            phase = 2 * np.pi * slow * (np.exp(growth * t) - 1.0) / growth
        motion = AMPLITUDE * np.sin(phase + joint) * ((time > still) & (time < still + chirp))
        start = still + chirp + 0.07 * joint
        levels = 1.3 * AMPLITUDE * rng.uniform(-1.0, 1.0, round(steps / every))
        step = np.floor((time - start) / every).astype(int)
        in_steps = (step >= 0) & (step < len(levels))
        motion[in_steps] += levels[step[in_steps]]
        last = still + chirp + steps + 0.3
        angle = 2 * np.pi * 0.35 * (1.0 + 0.23 * joint) * (time - last)
        motion += (time > last) * 1.3 * AMPLITUDE * 2 / np.pi * np.arcsin(np.sin(angle))
        columns.append(center + motion)
    return np.stack(columns, axis=1)


def make_trial(hung: mujoco.MjSpec, joints: tuple[str, ...], seed: int, with_torque: bool) -> Trial:
    """Return a noisy, quantized log of joints with random drives, simulated in steps of 0.5 ms."""
    rng = np.random.default_rng(seed)
    effort = np.array([JOINTS[joint][1] for joint in joints])
    true = {kind: rng.uniform(low, high, len(joints)) for kind, (low, high) in RANGES.items()}
    substeps = round(1.0 / RATE / PHYSICS)
    lag = round(rng.uniform(*DELAY) / PHYSICS)
    at_rest, speed = rng.uniform(*REST, len(joints)), rng.uniform(*REST_SPEED, len(joints))
    model = build_limb(hung, joints, PHYSICS)
    model.dof_armature[:], model.dof_damping[:] = true["armature"], true["damping"]
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = true["kp"], -true["kp"]
    model.actuator_biasprm[:, 2] = -true["kd"]
    model.actuator_forcelimited[:] = True
    model.actuator_forcerange[:] = np.stack([-effort, effort], axis=1)
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    target = targets(rng, [JOINTS[joint][0] for joint in joints])
    sent = np.repeat(target, substeps, axis=0)
    # The leg comes to rest first.
    sent = np.concatenate([np.tile(target[0], (round(1.0 / PHYSICS), 1)), sent])
    rows = []
    data.qpos[:] = target[0]
    for n in range(len(sent)):
        data.ctrl[:] = sent[max(0, n - lag)]
        if n >= len(sent) - len(target) * substeps and n % substeps == 0:
            torque = true["kp"] * (data.ctrl - data.qpos) - true["kd"] * data.qvel
            rows.append((data.qpos.copy(), data.qvel.copy(), np.clip(torque, -effort, effort)))
        above = (at_rest - 1.0) * np.exp(-((data.qvel / speed) ** 2))
        model.dof_frictionloss[:] = true["friction"] * (1.0 + above)
        mujoco.mj_step(model, data)
    position, velocity, torque = (np.stack(values) for values in zip(*rows, strict=True))

    def measured(values: np.ndarray, deviation: float, digit: float) -> np.ndarray:
        return digit * np.round((values + rng.normal(0.0, deviation, values.shape)) / digit)

    return Trial(
        JointLog(
            1.0 / RATE,
            joints,
            target,
            measured(position, *POSITION),
            measured(velocity, *VELOCITY),
            measured(torque, *TORQUE) if with_torque else None,
        ),
        true,
        lag * PHYSICS,
    )


def count(estimates: list[LimbEstimate], trials: list[Trial]) -> bool:
    """Print how often intervals hold the true value, and their widths; return True if as required."""
    print(
        f"{'parameter':<10} {'inside':>9} {'median':>8} {'largest width':>14} {'median error':>13}"
    )
    passed = True
    for kind in KINDS:
        rows = [
            (drive.parameters[kind], trial.true[kind][j])
            for estimate, trial in zip(estimates, trials, strict=True)
            for j, drive in enumerate(estimate.drives)
        ]
        inside = sum(abs(found.value - true) <= found.half_width for found, true in rows)
        widths = np.array([found.half_width / true for found, true in rows])
        errors = np.array([abs(found.value / true - 1.0) for found, true in rows])
        print(
            f"{kind:<10} {inside:>4}/{len(rows):<4} {np.median(widths):>8.1%} {widths.max():>14.1%} "
            f"{np.median(errors):>13.1%}"
        )
        passed &= inside >= 0.95 * len(rows) and widths.max() <= WIDTH
    delays = [(e.delay, t.delay) for e, t in zip(estimates, trials, strict=True)]
    inside = sum(abs(found.value - true) <= found.half_width for found, true in delays)
    widths = np.array([1e3 * found.half_width for found, _ in delays])
    errors = np.array([1e3 * abs(found.value - true) for found, true in delays])
    print(
        f"{'delay':<10} {inside:>4}/{len(delays):<4} {np.median(widths):>5.2f} ms {widths.max():>11.2f} ms "
        f"{np.median(errors):>10.2f} ms"
    )
    return passed and inside >= 0.95 * len(delays) and widths.max() <= 1e3 * DELAY_WIDTH


def main() -> None:
    """Fit some trials, and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--without-torque", action="store_true")
    parser.add_argument("--joints", nargs="+", choices=JOINTS, default=list(JOINTS))
    args = parser.parse_args()
    hung = hang(get_go1_robot_cfg().spec_fn())
    drives = Drives(
        dict.fromkeys(args.joints, 35.0),
        dict.fromkeys(args.joints, 1.0),
        {joint: JOINTS[joint][1] for joint in args.joints},
    )
    trials, estimates = [], []
    for seed in range(args.trials):
        trials.append(make_trial(hung, tuple(args.joints), seed, not args.without_torque))
        estimates += fit_robot(hung, drives, [trials[-1].log], num_threads=2)
        print(f"trial {seed + 1} of {args.trials}", file=sys.stderr, flush=True)
        for drive in estimates[-1].drives:
            for remark in drive.remarks:
                print(f"  {drive.joints[0]}: {remark}", file=sys.stderr, flush=True)
    raise SystemExit(0 if count(estimates, trials) else 1)


if __name__ == "__main__":
    main()
