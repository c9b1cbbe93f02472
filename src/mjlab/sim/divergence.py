"""Diverged physics: MuJoCo's warnings, the joint responsible, and advice.

By default MuJoCo prints every warning and appends it to `MUJOCO_LOG.TXT` in the working directory.
With robots diverging in many environments, that file grows to gigabytes. So warnings are counted by
kind and logged once per kind.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import torch

if TYPE_CHECKING:
    from mjlab.sim.simulation import Simulation

logger = logging.getLogger(__name__)

# Largest motion per physics step that a step can resolve: half a turn (rad), or one meter.
_HALF_TURN = math.pi
_METER = 1.0
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)

_NUMBERS = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
_counts: Counter[str] = Counter()
_lock = threading.Lock()


class DivergenceLog:
    """Logs the first divergence of an environment, with the joint responsible.

    Attributes:
        is_done: True once a divergence was logged; later steps are not monitored.
    """

    def __init__(self, sim: Simulation) -> None:
        self.is_done = False
        self._sim = sim
        self._velocities = sim.data.qvel.clone()

    def begin_step(self) -> None:
        """Store the velocities at the start of the step."""
        if not self.is_done:
            self._velocities.copy_(self._sim.data.qvel)

    def report(self, diverged: torch.Tensor, step: int) -> None:
        """Log the first environment of the mask `diverged`, (N,), if any. Called before resets."""
        if self.is_done:
            return
        ids = diverged.nonzero()
        if len(ids) == 0:
            return
        self.is_done = True
        env = int(ids[0])
        model = self._sim.mj_model
        velocity = self._sim.data.qvel[env]
        if not bool(torch.isfinite(velocity).any()):
            # One NaN joint makes its whole kinematic tree NaN within a step.
            velocity = self._velocities[env]
        speeds = velocity.abs().tolist()
        dof, motion = fastest_dof(model, speeds)
        if motion > 1.0:
            joint, cure = describe_dof(model, dof, speeds[dof]), cure_of(model, dof)
        # The divergence began within the step, or a term or event wrote the bad state.
        elif (found := self._sim.bad_dof(env)) is not None:
            name = model.joint(int(model.dof_jntid[found])).name
            joint, cure = f"MuJoCo found the state of joint {name!r} bad", cure_of(model, found)
        else:
            joint = "its state is not finite"
            cure = (
                f"Use a smaller sim.mujoco.timestep (now {float(model.opt.timestep):g} s) unless a "
                "term or an event wrote this state."
            )
        logger.warning(
            "The physics of environment %d diverged in step %d: %s. The episode ended with zero reward "
            "for that step. Later divergences are counted as Simulation/nan_resets. %s",
            env, step, joint, cure,
        )  # fmt: skip


def fastest_dof(model: mujoco.MjModel, speeds: Sequence[float]) -> tuple[int, float]:
    """Return the degree of freedom that moves farthest in a physics step.

    Args:
        model: Compiled model.
        speeds: Absolute velocity of each degree of freedom (m/s or rad/s), (nv,). NaN: infinite.

    Returns:
        Index (-1 if nv is 0), and motion per physics step divided by half a turn, or by one meter.
    """
    timestep = float(model.opt.timestep)
    motions = [
        (math.inf if math.isnan(speed) else speed)
        * timestep
        / (_METER if _is_linear(model, dof) else _HALF_TURN)
        for dof, speed in enumerate(speeds)
    ]
    worst = max(range(len(motions)), key=motions.__getitem__, default=-1)
    return worst, motions[worst] if worst >= 0 else 0.0


def describe_dof(model: mujoco.MjModel, dof: int, speed: float) -> str:
    """Return joint name and speed of a degree of freedom: `joint 'knee' reached 1e+03 rad/s`."""
    joint = model.joint(int(model.dof_jntid[dof]))
    unit = "m/s" if _is_linear(model, dof) else "rad/s"
    return f"joint {joint.name!r} reached {speed:.3g} {unit}"


def cure_of(model: mujoco.MjModel, dof: int) -> str:
    """Return advice to keep a degree of freedom from diverging, as sentences."""
    integrator = mujoco.mjtIntegrator(model.opt.integrator)
    fast = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    other = "" if integrator == fast else ", or set sim.mujoco.integrator to 'implicitfast'"
    return (
        "MuJoCo does not integrate the damping of an actuator at its effort limit implicitly, so a "
        "stiff position actuator on a light link diverges at a large timestep. Decrease "
        f"sim.mujoco.timestep (now {float(model.opt.timestep):g} s), increase the joint's armature "
        f"(now {float(model.dof_armature[dof]):g}) or viscous_damping (now "
        f"{float(model.dof_damping[dof]):g}), decrease the actuator's stiffness and damping, or "
        f"remove its effort_limit{other}."
    )


def _is_linear(model: mujoco.MjModel, dof: int) -> bool:
    joint = int(model.dof_jntid[dof])
    kind = int(model.jnt_type[joint])
    return kind == _SLIDE or (kind == _FREE and dof - int(model.jnt_dofadr[joint]) < 3)


# MuJoCo's warnings.


def collect_mujoco_warnings() -> None:
    """Log and count MuJoCo's warnings in this process, unless a handler is already set."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_handle_warning)


def mujoco_warnings() -> dict[str, int]:
    """Return the number of MuJoCo warnings in this process by kind (text without numbers)."""
    with _lock:
        return dict(_counts)


def _handle_warning(text: str) -> None:
    # Called from physics threads.
    kind = _NUMBERS.sub("#", text)
    with _lock:
        _counts[kind] += 1
        is_new = _counts[kind] == 1
    if is_new:
        logger.warning(
            "MuJoCo: %s Further warnings of this kind are counted.", text.rstrip(". ") + "."
        )
