"""What makes a task easier while its learning begins, for `cpu` profiles, and what undoes it.

Weights, pushes and starts are eased by curriculum terms, which change what is in use and no config. So
what a flag says of them is where they end, and without those terms the task is as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.manager_base import ManagerTermBase

Undo = Callable[[ManagerBasedRlEnvCfg], None]
"""Gives a config, or a copy of it, back what was changed."""

Ranges = dict[str, tuple[float, float]]

_PUSH = "push_robot"
_NUM_STAGES = 60


def ease_weight(env_cfg: ManagerBasedRlEnvCfg, name: str, first: float, steps: int) -> None:
    """Let the weight of a reward go from `first` to what it is, over so many environment steps."""
    params = {"reward_name": name, "first": first, "steps": steps}
    env_cfg.curriculum[f"eased_{name}"] = CurriculumTermCfg(func=GrowingWeight, params=params)


def ease_pushes(env_cfg: ManagerBasedRlEnvCfg, steps: int) -> None:
    """Let the pushes of the event `push_robot` grow from nothing to what they are."""
    if env_cfg.events.get(_PUSH) is not None:
        params = {"event_name": _PUSH, "steps": steps}
        env_cfg.curriculum[f"eased_{_PUSH}"] = CurriculumTermCfg(func=GrowingPushes, params=params)


def drop_easing(env_cfg: ManagerBasedRlEnvCfg) -> None:
    """Take the curriculum terms of this module, and those derived from them, out of a config."""
    for name, term in list(env_cfg.curriculum.items()):
        func = None if term is None else term.func
        if isinstance(func, type) and issubclass(func, Easing):
            del env_cfg.curriculum[name]


def coarsen_physics(env_cfg: ManagerBasedRlEnvCfg) -> Undo:
    """Take half as many physics steps, of twice the length, for a step of the environment.

    Histories of contact sensors keep their number of physics steps. What a flag has changed since is
    not undone.

    Raises:
        ValueError: the number of physics steps is odd.
    """
    fine = (env_cfg.sim.mujoco.timestep, env_cfg.decimation)
    if env_cfg.decimation % 2:
        raise ValueError(
            f"The physics cannot take half of {env_cfg.decimation} steps; decimation has to be even."
        )
    coarse = (2.0 * fine[0], fine[1] // 2)
    env_cfg.sim.mujoco.timestep, env_cfg.decimation = coarse

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        if (eased.sim.mujoco.timestep, eased.decimation) == coarse:
            eased.sim.mujoco.timestep, eased.decimation = fine

    return undo


def undo_all(undos: Sequence[Undo]) -> Undo:
    """Return what undoes all of these, one after the other."""

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        for one in undos:
            one(eased)

    return undo


class Easing(ManagerTermBase):
    """Base of curriculum terms that ease something until so many environment steps are made."""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)

    def fraction(self, steps: int) -> float:
        """Return how much of `steps` is over, from 0 to 1."""
        return min(self._env.common_step_counter / steps, 1.0)


class GrowingWeight(Easing):
    """Lets the weight of a reward go from `first` to what it was built with, a little at a time.

    Returns the weight. A reward that the task does not have is left alone.
    """

    _transient = {"_last"}

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        name = cfg.params["reward_name"]
        has_it = env.cfg.rewards.get(name) is not None
        self._last = env.reward_manager.get_term_cfg(name).weight if has_it else None

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | slice,
        reward_name: str,
        first: float,
        steps: int,
    ) -> float | None:
        if self._last is None:
            return None
        # Of stages 0, 1, ..., stage k begins with step k * steps // _NUM_STAGES.
        stage = (_NUM_STAGES * (env.common_step_counter + 1) - 1) // steps
        weight = first + (self._last - first) * min(stage, _NUM_STAGES) / _NUM_STAGES
        env.reward_manager.get_term_cfg(reward_name).weight = weight
        return weight


class GrowingPushes(Easing):
    """Lets pushes grow from nothing to the `velocity_range` that they were built with.

    Returns the fraction that they have reached. An event that the task does not have is left alone.
    """

    _transient = {"_full"}

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        name = cfg.params["event_name"]
        self._full: Ranges | None = None
        if env.cfg.events.get(name) is not None:
            self._full = dict(self._params(name)["velocity_range"])

    def __call__(
        self, env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice, event_name: str, steps: int
    ) -> float | None:
        if self._full is None:
            return None
        part = self.fraction(steps)
        grown = {axis: (part * low, part * high) for axis, (low, high) in self._full.items()}
        self._params(event_name)["velocity_range"] = grown
        return part

    def _params(self, event_name: str) -> dict[str, Any]:
        return self._env.event_manager.get_term_cfg(event_name).params
