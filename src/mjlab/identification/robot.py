"""Fit of all limbs of a robot to its logs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.identification.estimate import LimbEstimate, limb_estimate
from mjlab.identification.fit import LEAST_WINDOWS, SETTLE, WINDOW, fit_limb
from mjlab.identification.limb import build_limb, hang, split_into_limbs
from mjlab.identification.log import JointLog
from mjlab.identification.plant import KINDS, Plant
from mjlab.utils.errors import UserError
from mjlab.utils.string import compile_pattern

_FRICTION_GUESS = 0.02
"""First guess of dry friction as a share of the effort limit."""
_BANDWIDTH_GUESS = 10.0
"""Natural frequency (Hz) of a servo with its armature, for the first guess of an armature that the model
lacks: gains are often chosen by it."""
_DAMPING_GUESS = 0.3
"""First guess of viscous friction as a share of kd."""
_KD_LEAST = 0.02
"""Scale of a gain kd that is 0, as a share of kp (s)."""
_DELAY_GUESS, _DELAY_SCALE = 0.005, 0.01

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Drives:
    """Drives of a robot before the fit: commanded gains and effort limits, by joint."""

    stiffness: dict[str, float]
    """Commanded gains kp (N m/rad or N/m): first guesses."""
    damping: dict[str, float]
    """Commanded gains kd (N m s/rad or N s/m): first guesses."""
    effort_limit: dict[str, float]
    """Effort limits (N m or N); joints without one are unlimited."""


def fit_robot(
    spec: mujoco.MjSpec,
    drives: Drives,
    logs: Sequence[JointLog],
    shared: Sequence[str] = (),
    num_threads: int = 1,
) -> list[LimbEstimate]:
    """Return the estimates of each limb of a robot that hangs by its base.

    Args:
        spec: Robot with named bodies.
        drives: First guesses.
        logs: Logs of the same joints at the same rate.
        shared: Joint name patterns: the joints of each share their parameters.
        num_threads: Threads of the simulation.

    Raises:
        UserError: logs are too short, their joints or rates differ, or the robot lacks a joint or its
            gains.
    """
    first = logs[0]
    _check_length(logs)
    for log in logs[1:]:
        if log.joints != first.joints or abs(log.period - first.period) > 0.01 * first.period:
            raise UserError(
                f"Logs: expected the joints {list(first.joints)} and the period {first.period:.4g} s of the "
                f"first, got {list(log.joints)} and {log.period:.4g} s; use one call for each."
            )
    missing = [j for j in first.joints if j not in drives.stiffness or j not in drives.damping]
    if missing:
        raise UserError(
            f"Joints {missing}: expected position-controlled actuators with gains, got none in the robot; "
            "use --stiffness and --damping for the commanded gains."
        )
    groups = _groups(first.joints, shared)
    hung = hang(spec)
    limbs = split_into_limbs(hung, first.joints, groups)
    estimates = []
    for number, joints in enumerate(limbs, 1):
        logger.info("limb %d of %d: %s", number, len(limbs), ", ".join(joints))
        own_groups = [group for group in groups if group[0] in joints]
        own_logs = [log.of(joints) for log in logs]
        estimates.append(_fit(hung, drives, own_logs, own_groups, num_threads))
    return estimates


def _check_length(logs: Sequence[JointLog]) -> None:
    """Raise unless the logs have the windows that intervals need."""
    used = [log.duration - SETTLE for log in logs]
    # A row is the precision of a window.
    slack = logs[0].period
    if min(used) < WINDOW - slack or sum(used) < LEAST_WINDOWS * WINDOW - slack:
        lengths = ", ".join(f"{log.duration:.3g}" for log in logs)
        raise UserError(
            f"Logs: expected {SETTLE + LEAST_WINDOWS * WINDOW:g} s of motion or more, got {lengths} s; use "
            f"longer ones, or several (--more), each of {SETTLE + WINDOW:g} s or more."
        )


def _groups(joints: Sequence[str], shared: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the joints of each pattern, and other joints alone."""
    groups: list[tuple[str, ...]] = []
    rest = list(joints)
    for pattern in shared:
        matches = compile_pattern(pattern).fullmatch
        found = tuple(joint for joint in rest if matches(joint))
        if not found:
            raise UserError(
                f"--share {pattern!r}: expected to match joints of the log, got none; use names of "
                f"{list(joints)}."
            )
        groups.append(found)
        rest = [joint for joint in rest if joint not in found]
    return [*groups, *((joint,) for joint in rest)]


def _fit(
    hung: mujoco.MjSpec,
    drives: Drives,
    logs: Sequence[JointLog],
    groups: Sequence[tuple[str, ...]],
    num_threads: int,
) -> LimbEstimate:
    joints = logs[0].joints
    model = build_limb(hung, joints, logs[0].period)
    effort = np.array([drives.effort_limit.get(joint, np.inf) for joint in joints])
    group_of = [next(n for n, group in enumerate(groups) if j in group) for j in joints]
    plant = Plant(model, logs, group_of, effort, num_threads)
    leads = [group[0] for group in groups]
    start, scale = _first_guess(model, drives, leads, logs[0].period)
    return limb_estimate(fit_limb(plant, start, scale), groups)


def _first_guess(
    model: mujoco.MjModel, drives: Drives, joints: Sequence[str], period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return first guess and scale of the parameters, (P,), of one joint of each group."""
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    kp = np.array([drives.stiffness[joint] for joint in joints])
    kd = np.array([drives.damping[joint] for joint in joints])
    # A servo without a limit still has errors of a few tenths of a radian.
    effort = np.array(
        [drives.effort_limit.get(joint, 0.5 * k) for joint, k in zip(joints, kp, strict=True)]
    )
    typical = {
        "armature": kp / (2.0 * np.pi * _BANDWIDTH_GUESS) ** 2,
        "damping": _DAMPING_GUESS * np.maximum(kd, _KD_LEAST * kp),
        "friction": _FRICTION_GUESS * effort,
        "kp": kp,
        "kd": np.maximum(kd, _KD_LEAST * kp),
    }
    own = {
        "armature": model.dof_armature[dofs],
        "damping": model.dof_damping[dofs],
        "friction": model.dof_frictionloss[dofs],
        "kp": kp,
        "kd": kd,
    }
    guess = np.stack([typical[kind] for kind in KINDS], axis=1).ravel()
    model_values = np.stack([own[kind] for kind in KINDS], axis=1).ravel()
    start = np.where(model_values > 0.0, model_values, guess)
    return (
        np.array([*start, 0.0, _DELAY_GUESS]),
        np.array([*np.maximum(start, guess), 0.5 * period, _DELAY_SCALE]),
    )
