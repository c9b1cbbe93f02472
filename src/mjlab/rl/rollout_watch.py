"""Checks of rollouts: diverged physics, and terms that are NaN in every environment."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import mujoco
import torch

from mjlab.rl.checkpoint import not_finite
from mjlab.sim.divergence import cure_of, describe_dof, fastest_dof
from mjlab.utils.errors import MjlabError
from mjlab.utils.string import counted

# Terms may be NaN in the first step of all episodes, and iterations of SAC are short.
_MIN_BROKEN_STEPS = 16
# With few environments, a single one may diverge.
_MIN_DIVERGED_EPISODES = 4
# Texts in errors about numbers that are not finite.
_ABOUT_NAN = ("elements of std >= 0", "NaN")
# Observations whose squares, or the sums of these, may overflow.
_TOO_LARGE = 1e10


class DivergedError(MjlabError, RuntimeError):
    """Training failure: the physics of a joint diverged, or the weights are NaN or infinite."""


class BrokenTermError(MjlabError, ValueError):
    """Action, reward or termination that was NaN or infinite in all environments for an iteration."""


class RolloutWatch:
    """Peak speed of each DoF in this rollout and the previous one, to name a diverged joint.

    The policy learns from a rollout after it, so the first NaN may appear in the next one.
    A step costs two small operations on the device of the environments, and no synchronization.
    """

    def __init__(self, env: Any, algorithm: Any) -> None:
        """Watch `env` (not checked without a simulation) and a new rsl_rl `algorithm`."""
        self._env = env
        # May be meant, such as the logarithm of a standard deviation of 0.
        self._not_finite_at_first = not_finite(algorithm.save())
        self._sim: Any = getattr(env, "sim", None)
        self._peak: torch.Tensor | None = None
        self._previous_peak: torch.Tensor | None = None
        self._resets_before: torch.Tensor | None = None

    def start(self) -> None:
        """Start a rollout with the current speeds."""
        if self._sim is not None:
            self._previous_peak, self._peak = self._peak, self._speeds()
            # Environments of other classes may have a simulation but no `nan_resets`.
            if (resets := getattr(self._env, "nan_resets", None)) is not None:
                self._resets_before = resets.clone()

    def update(self) -> None:
        """Update the peak speeds after a step."""
        if self._peak is not None:
            torch.maximum(self._peak, self._speeds(), out=self._peak)

    def check(self, num_steps: int) -> None:
        """Check that a rollout of `num_steps` steps is usable for learning.

        Raises:
            DivergedError: most environments diverged, in at least 4 episodes.
            BrokenTermError: an action or reward was NaN or infinite, or a termination a float other
                than 0 and 1, in every environment and every step (at least 16 steps).
        """
        if self._resets_before is None:
            return
        episodes = self._env.nan_resets - self._resets_before
        diverged = int((episodes > 0).sum())
        if 2 * diverged > self._env.num_envs and int(episodes.sum()) >= _MIN_DIVERGED_EPISODES:
            timestep = float(self._sim.mj_model.opt.timestep)
            cause = self._explanation() or (
                f"sim.mujoco.timestep is {timestep:g} s; use a smaller one."
            )
            raise DivergedError(
                f"The physics diverged in {diverged} of {counted(self._env.num_envs, 'environment')} within "
                f"{num_steps} steps: {cause}"
            )
        env = self._env
        for manager in (env.action_manager, env.reward_manager, env.termination_manager):
            remedy = "correct the term, or set it to None"
            if manager is env.action_manager:
                remedy = "check the policy, and use a smaller learning rate"
            manager.bad_values.report()
            for term, steps in manager.bad_values.streaks().items():
                if steps >= max(num_steps, _MIN_BROKEN_STEPS):
                    raise BrokenTermError(
                        f"{term} was {manager.bad_values.fault} in every environment for {steps} steps in a "
                        f"row; {remedy}."
                    )

    @contextmanager
    def explaining(self, algorithm: Any) -> Generator[None]:
        """Raise `DivergedError` instead of errors about NaN, and after a block that left NaN or infinity.

        Checked are weights, statistics and moments of the optimizer.
        The cause is a joint that was too fast for the physics timestep, or else the learning. Errors of
        a network with finite weights pass if no joint was too fast.

        Args:
            algorithm: The algorithm, after any number of updates.
        """
        error: Exception | None = None
        try:
            yield
        except (DivergedError, BrokenTermError):
            raise
        except (RuntimeError, ValueError) as raised:
            error = raised
        names = not_finite(algorithm.save())
        broken = [name for name in names if name not in self._not_finite_at_first]
        if not broken:
            if error is None:
                return
            if not any(text in str(error) for text in _ABOUT_NAN):
                raise error
        if (message := self._explanation()) is not None:
            raise DivergedError(
                f"The physics diverged, and the policy learned from it: {message}"
            ) from error
        if error is not None and not broken:
            raise error
        rate = getattr(algorithm, "learning_rate", None)
        raise DivergedError(
            f"The policy diverged: its weights are NaN or infinite, first {broken[0]}."
            + "".join(f" {text}" for text in self._large_observations())
            + " Use a smaller learning rate"
            + ("." if rate is None else f" (now {rate:g}).")
        ) from error

    def _large_observations(self) -> list[str]:
        """Return sentences about the groups of observations that no network can learn from."""
        buffers = getattr(self._env, "obs_buf", None) or {}
        largest = {
            name: float(value.abs().max())
            for name, value in buffers.items()
            if isinstance(value, torch.Tensor) and value.numel() > 0
        }
        return [
            f"Observations of group {name!r} reach {value:.3g}: scale or clip them."
            for name, value in largest.items()
            if not value < _TOO_LARGE
        ]

    def _speeds(self) -> torch.Tensor:
        # Environments whose state is not finite were reset within the step.
        return self._sim.data.qvel.abs().amax(dim=0)

    def _explanation(self) -> str | None:
        """Return the joint that diverged and the remedy; None if no joint is too fast."""
        if self._peak is None:
            return None
        model: mujoco.MjModel = self._sim.mj_model
        peak = self._peak.maximum(self._speeds())
        if self._previous_peak is not None:
            peak = peak.maximum(self._previous_peak)
        speeds = peak.tolist()
        dof, excess = fastest_dof(model, speeds)
        if excess <= 1.0:
            return None
        return (
            f"{describe_dof(model, dof, speeds[dof])}, too fast for a timestep of "
            f"{float(model.opt.timestep):g} s. {cure_of(model, dof)}"
        )
