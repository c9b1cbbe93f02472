"""Diverged physics: names the joint when training fails on numbers that are not finite."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import mujoco
import torch

# No step resolves a faster motion: half a turn (rad), or one meter, in each physics step.
_HALF_TURN = math.pi
_METER = 1.0
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


class DivergedError(RuntimeError):
    """Training failed because the physics of a joint diverged."""


class SpeedWatch:
    """Highest speed of each degree of freedom in this rollout and the one before.

    The policy learns from a rollout after it, so the first NaN may appear in the next one.
    Watching costs two small operations on the device of the environments, and no synchronization.
    """

    def __init__(self, env: Any) -> None:
        """Watch `env`; one without a simulation is left alone."""
        self._sim: Any = getattr(env, "sim", None)
        self._peak: torch.Tensor | None = None
        self._previous_peak: torch.Tensor | None = None

    def start(self) -> None:
        """Begin a rollout with the current speeds."""
        if self._sim is not None:
            self._previous_peak, self._peak = self._peak, self._speeds()

    def update(self) -> None:
        """Update the highest speeds after a step."""
        if self._peak is not None:
            torch.maximum(self._peak, self._speeds(), out=self._peak)

    @contextmanager
    def explaining(self, policy: torch.nn.Module) -> Generator[None]:
        """Raise `DivergedError` in place of errors about numbers that are not finite.

        Only if a joint was faster than a physics step resolves; other errors pass.
        """
        try:
            yield
        except (RuntimeError, ValueError) as error:
            message = self._explanation() if _is_about_numbers(error, policy) else None
            if message is None:
                raise
            raise DivergedError(message) from error

    def _speeds(self) -> torch.Tensor:
        # Environments whose state is not finite were reset within the step.
        return self._sim.data.qvel.abs().amax(dim=0)

    def _explanation(self) -> str | None:
        """Return what diverged and what cures it; None if no joint is too fast."""
        if self._peak is None:
            return None
        model: mujoco.MjModel = self._sim.mj_model
        timestep = float(model.opt.timestep)
        peak = self._peak.maximum(self._speeds())
        if self._previous_peak is not None:
            peak = peak.maximum(self._previous_peak)
        speeds = peak.nan_to_num(nan=math.inf).tolist()
        excess = [
            speed * timestep / (_METER if _is_linear(model, dof) else _HALF_TURN)
            for dof, speed in enumerate(speeds)
        ]
        worst = max(range(len(excess)), key=excess.__getitem__, default=-1)
        if worst < 0 or excess[worst] <= 1.0:
            return None
        joint = model.joint(int(model.dof_jntid[worst]))
        unit = "m/s" if _is_linear(model, worst) else "rad/s"
        integrator = mujoco.mjtIntegrator(model.opt.integrator)
        fast = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        other = "" if integrator == fast else ", set sim.mujoco.integrator to 'implicitfast'"
        return (
            f"The physics diverged: joint {joint.name!r} reached {speeds[worst]:.3g} {unit}, too fast "
            f"for a timestep of {timestep:g} s, and the policy learned from it. MuJoCo leaves the "
            "damping of an actuator at its effort limit out of the implicit integration, so a stiff "
            "position actuator on a light link diverges at a coarse step. Use a smaller "
            f"sim.mujoco.timestep, or give the joint more armature (now "
            f"{float(model.dof_armature[worst]):g}) or viscous_damping (now "
            f"{float(model.dof_damping[worst]):g}), or its actuator less stiffness and damping or no "
            f"effort_limit{other}."
        )


def _is_linear(model: mujoco.MjModel, dof: int) -> bool:
    joint = int(model.dof_jntid[dof])
    kind = int(model.jnt_type[joint])
    return kind == _SLIDE or (kind == _FREE and dof - int(model.jnt_dofadr[joint]) < 3)


def _is_about_numbers(error: Exception, policy: torch.nn.Module) -> bool:
    """Return whether an error comes from NaN: in the action distribution, the policy or a step."""
    said = str(error)
    if "elements of std >= 0" in said or "NaN" in said:
        return True
    tensors = [*policy.parameters(), *policy.buffers()]
    return any(t.is_floating_point() and not bool(torch.isfinite(t).all()) for t in tensors)
