"""Diverged physics: the joint that diverged, and advice to prevent it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco

# Largest motion per physics step that a step can resolve: half a turn (rad), or one meter.
_HALF_TURN = math.pi
_METER = 1.0
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


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
