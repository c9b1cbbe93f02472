"""What makes a task easier while its learning begins, for `cpu` profiles, and what undoes it.

Weights, pushes, commands, noise and starts are eased by curriculum terms, which change what is in use
and no config. So what a flag says of them is where they end, and without those terms the task is as it
was.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.manager_base import ManagerTermBase
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.utils.noise import (
    ConstantNoiseCfg,
    GaussianNoiseCfg,
    NoiseCfg,
    NoiseModelCfg,
    UniformNoiseCfg,
)

Undo = Callable[[ManagerBasedRlEnvCfg], None]
"""Gives a config, or a copy of it, back what was changed."""

Ranges = dict[str, tuple[float, float]]

_PUSH = "push_robot"
_ROBOT = "robot"
_SLIDING = 3
_NUM_STAGES = 60
_COMMAND_RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
_NOISE_SIZES: dict[type[NoiseCfg], tuple[str, ...]] = {
    ConstantNoiseCfg: ("bias",),
    GaussianNoiseCfg: ("mean", "std"),
    UniformNoiseCfg: ("n_min", "n_max"),
}


def ease_weight(env_cfg: ManagerBasedRlEnvCfg, name: str, first: float, steps: int) -> None:
    """Let the weight of a reward go from `first` to what it is, over so many environment steps."""
    params = {"reward_name": name, "first": first, "steps": steps}
    env_cfg.curriculum[f"eased_{name}"] = CurriculumTermCfg(func=GrowingWeight, params=params)


def ease_pushes(env_cfg: ManagerBasedRlEnvCfg, steps: int) -> None:
    """Let the pushes of the event `push_robot` grow from nothing to what they are."""
    if env_cfg.events.get(_PUSH) is not None:
        params = {"event_name": _PUSH, "steps": steps}
        env_cfg.curriculum[f"eased_{_PUSH}"] = CurriculumTermCfg(func=GrowingPushes, params=params)


def grow_difficulty(
    env_cfg: ManagerBasedRlEnvCfg, reward_name: str, tracking: float, **params: Any
) -> None:
    """Let commands, pushes and observation noise grow to what they are, while a policy copes.

    Args:
        env_cfg: Config to edit.
        reward_name: Reward term that tells how well commands are followed.
        tracking: Fraction of its largest value that it must exceed.
        **params: Further parameters of `GrowingDifficulty`.
    """
    params = {"reward_name": reward_name, "tracking": tracking, **params}
    env_cfg.curriculum["difficulty"] = CurriculumTermCfg(func=GrowingDifficulty, params=params)


def drop_easing(env_cfg: ManagerBasedRlEnvCfg) -> None:
    """Take the curriculum terms of this module, and those derived from them, out of a config."""
    for name, term in list(env_cfg.curriculum.items()):
        func = None if term is None else term.func
        if isinstance(func, type) and issubclass(func, Easing):
            del env_cfg.curriculum[name]


def coarsen_physics(env_cfg: ManagerBasedRlEnvCfg, num_steps: int) -> Undo:
    """Take only `num_steps` physics steps, longer ones, for a step of the environment.

    Histories of contact sensors keep their number of physics steps. What a flag has changed since is
    not undone.

    Raises:
        ValueError: these are no fewer steps.
    """
    fine = (env_cfg.sim.mujoco.timestep, env_cfg.decimation)
    if not 1 <= num_steps < env_cfg.decimation:
        raise ValueError(
            f"num_steps: expected 1 to {env_cfg.decimation - 1} physics steps, fewer than the task's "
            f"{env_cfg.decimation}, got {num_steps}."
        )
    coarse = (fine[0] * fine[1] / num_steps, num_steps)
    env_cfg.sim.mujoco.timestep, env_cfg.decimation = coarse

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        if (eased.sim.mujoco.timestep, eased.decimation) == coarse:
            eased.sim.mujoco.timestep, eased.decimation = fine

    return undo


def simplify_contacts(env_cfg: ManagerBasedRlEnvCfg) -> Undo:
    """Make friction cones pyramidal, and take rolling and torsional friction from the robot.

    On the Go1 that walks, the physics of a step takes half the time. Edits the config in place. Returns what gives such a config, or a copy, the contacts back.
    """
    cone = env_cfg.sim.mujoco.cone
    collisions = env_cfg.scene.entities[_ROBOT].collisions
    condim = [collision.condim for collision in collisions]
    env_cfg.sim.mujoco.cone = "pyramidal"
    for collision in collisions:
        dims = collision.condim
        if isinstance(dims, dict):
            collision.condim = {name: min(dim, _SLIDING) for name, dim in dims.items()}
        elif dims is not None:
            collision.condim = min(dims, _SLIDING)

    def undo(simple: ManagerBasedRlEnvCfg) -> None:
        simple.sim.mujoco.cone = cone
        for collision, dims in zip(simple.scene.entities[_ROBOT].collisions, condim, strict=True):
            collision.condim = dims

    return undo


def replace_rewards(
    env_cfg: ManagerBasedRlEnvCfg, rewards: dict[str, RewardTermCfg | None]
) -> Undo:
    """Reward these terms instead of the task's.

    Undone, the task's terms are there again, with the weights that flags have changed since, and None
    where flags have removed one.
    """
    before = dict(env_cfg.rewards)
    weights = {name: term.weight for name, term in rewards.items() if term is not None}
    env_cfg.rewards = dict(rewards)

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        now, eased.rewards = eased.rewards, copy.deepcopy(before)
        for name in before.keys() & weights.keys():
            term = now.get(name)
            if term is None or term.weight != weights[name]:
                eased.rewards[name] = term

    return undo


def undo_all(undos: Sequence[Undo]) -> Undo:
    """Return what undoes all of these, one after the other."""

    def undo(eased: ManagerBasedRlEnvCfg) -> None:
        for one in undos:
            one(eased)

    return undo


class Easing(ManagerTermBase):
    """Base of curriculum terms that ease something at first, such as for so many environment steps."""

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
            self._full = dict(env.event_manager.get_term_cfg(name).params["velocity_range"])

    def __call__(
        self, env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice, event_name: str, steps: int
    ) -> float | None:
        if self._full is None:
            return None
        part = self.fraction(steps)
        grown = {axis: _times(tuple(bounds), part) for axis, bounds in self._full.items()}
        env.event_manager.get_term_cfg(event_name).params["velocity_range"] = grown
        return part


class GrowingDifficulty(Easing):
    """Lets one difficulty d grow from 0 to 1, by `step`, after each interval in which a policy copes.

    It copes if, among the episodes that ended in the interval, the fraction that survived exceeds
    `survival`, and the mean of the reward term, as a fraction of its weight and over all their steps,
    exceeds `tracking`. An episode survives that lasts `survival_s`, or as long as the task lets it, and
    one falls that is terminated before. Episodes that a time-out cuts shorter, as training does that
    starts at random points of episodes, are neither. Steps are those really made since the reset.

    With d, these fractions of what was built are in use; what the task does not have is left alone:

        command ranges    command_from + (1 - command_from) d
        pushes            push_from + (1 - push_from) d
        noise             noise_from + (1 - noise_from) d

    Ranges that another curriculum term sets meanwhile become those to grow to.

    Params:
        reward_name: Reward term of positive weight, at most 1 without it.
        tracking: Least fraction of that.
        survival: Least fraction of episodes.
        survival_s: Time to survive (s).
        step: Growth of d.
        interval: Length of an interval (environment steps).
        command_name: Velocity command whose ranges lin_vel_x, lin_vel_y and ang_vel_z grow.
        command_from: Their fraction at d = 0.
        event_name: Event with a `velocity_range`.
        push_from: Its fraction at d = 0.
        noise_group: Observation group whose noise grows.
        noise_from: Its fraction at d = 0.

    Returns d.

    Raises, when built: `ValueError` for a reward term that does not exist or has no positive weight, or
    noise whose size is not known.
    """

    # Settings from the config.
    _transient = {"_pushes", "_noises"}

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        name = cfg.params["reward_name"]
        weight = env.reward_manager.get_term_cfg(name).weight
        if not weight > 0.0:
            raise ValueError(
                f"reward_name: expected a term of positive weight, got {name!r} of {weight}."
            )
        self.difficulty = 0.0
        self.last_survival, self.last_tracking = 0.0, 0.0
        self._interval_start = 0
        self._episode_start = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        # Of the interval: episodes that survived, that fell, their reward, and their steps.
        self._tally = torch.zeros(4, dtype=torch.float64, device=env.device)
        self._command_part = 1.0
        self._ranges = self._ranges_in_use(cfg.params.get("command_name", "twist"))
        event_name = cfg.params.get("event_name", _PUSH)
        self._pushes: Ranges | None = None
        if env.cfg.events.get(event_name) is not None:
            event = env.event_manager.get_term_cfg(event_name)
            self._pushes = dict(event.params["velocity_range"])
        self._noises = self._noises_of(cfg.params.get("noise_group", "actor"))

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | slice,
        reward_name: str,
        tracking: float,
        survival: float = 0.6,
        survival_s: float = 10.0,
        step: float = 0.05,
        interval: int = 1500,
        command_name: str = "twist",
        command_from: float = 0.5,
        event_name: str = _PUSH,
        push_from: float = 0.0,
        noise_group: str = "actor",
        noise_from: float = 0.2,
    ) -> float:
        self._count(env_ids, reward_name, survival_s)
        if env.common_step_counter - self._interval_start >= interval:
            if self._copes(reward_name, survival, tracking):
                self.difficulty = min(self.difficulty + step, 1.0)
            self._interval_start = env.common_step_counter
        d = self.difficulty
        part = command_from + (1.0 - command_from) * d
        for name, bounds in self._ranges_in_use(command_name).items():
            if bounds != _times(self._ranges[name], self._command_part):
                self._ranges[name] = bounds
            cfg: Any = env.command_manager.get_term_cfg(command_name)
            setattr(cfg.ranges, name, _times(self._ranges[name], part))
        self._command_part = part
        if self._pushes is not None:
            part = push_from + (1.0 - push_from) * d
            grown = {axis: _times(tuple(bounds), part) for axis, bounds in self._pushes.items()}
            env.event_manager.get_term_cfg(event_name).params["velocity_range"] = grown
        part = noise_from + (1.0 - noise_from) * d
        for noise, sizes in self._noises:
            for name, size in sizes.items():
                setattr(noise, name, _times(size, part))
        return d

    def _count(self, env_ids: torch.Tensor | slice, reward_name: str, survival_s: float) -> None:
        """Count the episodes that end. An evaluation in between makes no steps, and counts none."""
        env = self._env
        steps = env.common_step_counter - self._episode_start[env_ids]
        enough = math.ceil(min(survival_s, env.max_episode_length_s) / env.step_dt - 1e-6)
        survived = steps >= enough
        has_moved = steps > 0
        fell = env.termination_manager.terminated[env_ids] & has_moved & ~survived
        reward = env.reward_manager.episode_sum(reward_name)[env_ids] * has_moved
        self._tally += torch.stack(
            [part.sum().double() for part in (survived, fell, reward, steps)]
        )
        self._episode_start[env_ids] = env.common_step_counter

    def _copes(self, reward_name: str, survival: float, tracking: float) -> bool:
        """Return whether the policy coped in the interval, and reset the counters."""
        env = self._env
        survived, fell, reward, steps = self._tally.tolist()
        self._tally.zero_()
        unit = env.step_dt if env.cfg.scale_rewards_by_dt else 1.0
        weight = env.reward_manager.get_term_cfg(reward_name).weight
        self.last_survival = survived / max(survived + fell, 1.0)
        self.last_tracking = reward / (max(steps, 1.0) * unit * weight) if weight > 0.0 else 0.0
        return self.last_survival > survival and self.last_tracking > tracking

    def _ranges_in_use(self, command_name: str) -> Ranges:
        if self._env.cfg.commands.get(command_name) is None:
            return {}
        cfg: Any = self._env.command_manager.get_term_cfg(command_name)
        return {name: tuple(getattr(cfg.ranges, name)) for name in _COMMAND_RANGES}

    def _noises_of(self, group: str) -> list[tuple[NoiseCfg, dict[str, Any]]]:
        """Return the live noise configs of a group, each with its sizes as built."""
        manager = self._env.observation_manager
        noises = []
        for name in manager.active_terms.get(group, ()):
            noise = manager.get_term_cfg(group, name).noise
            parts: list[Any] = [noise]
            if isinstance(noise, NoiseModelCfg):
                parts = [noise.noise_cfg, getattr(noise, "bias_noise_cfg", None)]
            for part in parts:
                if part is None:
                    continue
                if type(part) not in _NOISE_SIZES or part.operation == "scale":
                    raise ValueError(
                        f"noise of {group}/{name}: expected constant, Gaussian or uniform noise that "
                        f"is added, got {part!r}; use another noise_group to leave it as it is."
                    )
                noises.append((part, {f: getattr(part, f) for f in _NOISE_SIZES[type(part)]}))
        return noises


def _times(size: Any, factor: float) -> Any:
    """Return a number, or each of a tuple, times `factor`."""
    return tuple(factor * s for s in size) if isinstance(size, tuple) else factor * size
