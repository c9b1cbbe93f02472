"""Diverged physics: the joint that blew up, and what keeps it from doing so."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco

# No step resolves a faster motion: half a turn (rad), or one meter, in each physics step.
_HALF_TURN = math.pi
_METER = 1.0
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


def fastest_dof(model: mujoco.MjModel, speeds: Sequence[float]) -> tuple[int, float]:
    """Return the degree of freedom that moves most in a physics step.

    Args:
        model: The model.
        speeds: Absolute velocity of each degree of freedom (nv,), m/s or rad/s; NaN counts as infinite.

    Returns:
        Its index (-1 without any), and its motion in a physics step over half a turn, or one meter.
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
    """Return the joint of a degree of freedom with its speed: `joint 'knee' reached 1e+03 rad/s`."""
    joint = model.joint(int(model.dof_jntid[dof]))
    unit = "m/s" if _is_linear(model, dof) else "rad/s"
    return f"joint {joint.name!r} reached {speed:.3g} {unit}"


def cure_of(model: mujoco.MjModel, dof: int) -> str:
    """Return what keeps a degree of freedom from diverging, as sentences."""
    integrator = mujoco.mjtIntegrator(model.opt.integrator)
    fast = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    other = "" if integrator == fast else ", set sim.mujoco.integrator to 'implicitfast'"
    return (
        "MuJoCo leaves the damping of an actuator at its effort limit out of the implicit integration, "
        "so a stiff position actuator on a light link diverges at a coarse step. Use a smaller "
        f"sim.mujoco.timestep (now {float(model.opt.timestep):g} s), or give the joint more armature "
        f"(now {float(model.dof_armature[dof]):g}) or viscous_damping (now "
        f"{float(model.dof_damping[dof]):g}), or its actuator less stiffness and damping or no "
        f"effort_limit{other}."
    )


def _is_linear(model: mujoco.MjModel, dof: int) -> bool:
    joint = int(model.dof_jntid[dof])
    kind = int(model.jnt_type[joint])
    return kind == _SLIDE or (kind == _FREE and dof - int(model.jnt_dofadr[joint]) < 3)
