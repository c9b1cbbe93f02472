"""Report of the first environment whose physics diverged, with the joint responsible."""

from __future__ import annotations

import logging

import torch

from mjlab.sim import Simulation
from mjlab.sim.divergence import cure_of, describe_dof, fastest_dof

logger = logging.getLogger(__name__)


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

    def end_step(self, diverged: torch.Tensor, step: int) -> None:
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
