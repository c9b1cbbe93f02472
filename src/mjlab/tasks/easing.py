"""Curricula and config edits that ease training, for the easing of a `Profile`.

Curriculum terms ease weights, pushes, commands and noise. They edit the live settings of the
managers and not the config, so flags set the final values.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch

from mjlab.actuator import ActuatorCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.managers.curriculum_manager import CurriculumTermCfg
from mjlab.managers.manager_base import ManagerTermBase
from mjlab.utils.noise import (
    ConstantNoiseCfg,
    GaussianNoiseCfg,
    NoiseCfg,
    NoiseModelCfg,
    UniformNoiseCfg,
)

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
    """Ramp a reward weight from `first` to its configured value over `steps` environment steps."""
    params = {"reward_name": name, "first": first, "steps": steps}
    env_cfg.curriculum[f"eased_{name}"] = CurriculumTermCfg(func=GrowingWeight, params=params)


def ease_pushes(env_cfg: ManagerBasedRlEnvCfg, steps: int) -> None:
    """Ramp the pushes of the event `push_robot` from zero to their range over `steps` steps."""
    if env_cfg.events.get(_PUSH) is not None:
        params = {"event_name": _PUSH, "steps": steps}
        env_cfg.curriculum[f"eased_{_PUSH}"] = CurriculumTermCfg(func=GrowingPushes, params=params)


def grow_difficulty(
    env_cfg: ManagerBasedRlEnvCfg, reward_name: str, tracking: float, **params: Any
) -> None:
    """Ramp commands, pushes and observation noise to their configured sizes as the policy improves.

    Args:
        env_cfg: Config to edit.
        reward_name: Reward term that measures command tracking.
        tracking: Fraction of the term's maximum that must be exceeded.
        **params: Further parameters of `GrowingDifficulty`.
    """
    params = {"reward_name": reward_name, "tracking": tracking, **params}
    env_cfg.curriculum["difficulty"] = CurriculumTermCfg(func=GrowingDifficulty, params=params)


def coarsen_physics(env_cfg: ManagerBasedRlEnvCfg, num_steps: int) -> None:
    """Reduce the decimation to `num_steps` and lengthen the physics timestep to match.

    Command delays of actuators keep their time, rounded to substeps; histories of contact sensors
    keep their number of substeps.

    Raises:
        ValueError: `num_steps` is not less than the decimation.
    """
    if not 1 <= num_steps < env_cfg.decimation:
        raise ValueError(
            f"num_steps: expected 1 to {env_cfg.decimation - 1} physics steps, fewer than the task's "
            f"{env_cfg.decimation}, got {num_steps}."
        )
    mujoco = env_cfg.sim.mujoco
    mujoco.timestep = mujoco.timestep * env_cfg.decimation / num_steps
    for entity in env_cfg.scene.entities.values():
        if entity.articulation is not None:
            # Tasks share the config of a robot: replaced, not edited.
            entity.articulation = dataclasses.replace(
                entity.articulation,
                actuators=tuple(
                    _with_scaled_delay(actuator, num_steps / env_cfg.decimation)
                    for actuator in entity.articulation.actuators
                ),
            )
    env_cfg.decimation = num_steps


def _with_scaled_delay(actuator: ActuatorCfg, factor: float) -> ActuatorCfg:
    """Return the actuator with `factor` times its command delay, in whole substeps."""
    if actuator.delay_max_lag == 0:
        return actuator
    return dataclasses.replace(
        actuator,
        delay_min_lag=round(factor * actuator.delay_min_lag),
        delay_max_lag=round(factor * actuator.delay_max_lag),
        delay_update_period=round(factor * actuator.delay_update_period),
    )


def simplify_contacts(env_cfg: ManagerBasedRlEnvCfg) -> None:
    """Use pyramidal friction cones, and remove torsional and rolling friction of the robot.

    Halves the physics time of a walking Go1.
    """
    env_cfg.sim.mujoco.cone = "pyramidal"
    for collision in env_cfg.scene.entities[_ROBOT].collisions:
        dims = collision.condim
        if isinstance(dims, dict):
            collision.condim = {name: min(dim, _SLIDING) for name, dim in dims.items()}
        elif dims is not None:
            collision.condim = min(dims, _SLIDING)


class Easing(ManagerTermBase):
    """Base class of curriculum terms that ease the start of training."""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(env)

    def fraction(self, steps: int) -> float:
        """Return the elapsed fraction of `steps` environment steps, in [0, 1]."""
        return min(self._env.common_step_counter / steps, 1.0)


class GrowingWeight(Easing):
    """Curriculum that ramps a reward weight from `first` to its configured value in 60 stages.

    Returns the weight; None if the task has no such reward.
    """

    _transient = {"_last"}

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        name = cfg.params["reward_name"]
        has_reward = env.cfg.rewards.get(name) is not None
        self._last = env.reward_manager.get_term_cfg(name).weight if has_reward else None

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
        # Stage k = 0, 1, ... begins at step k * steps // _NUM_STAGES.
        stage = (_NUM_STAGES * (env.common_step_counter + 1) - 1) // steps
        weight = first + (self._last - first) * min(stage, _NUM_STAGES) / _NUM_STAGES
        env.reward_manager.get_term_cfg(reward_name).weight = weight
        return weight


class GrowingPushes(Easing):
    """Curriculum that ramps pushes from zero to the configured `velocity_range`.

    Returns the fraction of the range in use; None if the task has no such event.
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
        grown = {axis: _scaled(tuple(bounds), part) for axis, bounds in self._full.items()}
        env.event_manager.get_term_cfg(event_name).params["velocity_range"] = grown
        return part


class GrowingDifficulty(Easing):
    """Curriculum that raises a difficulty d from 0 to 1, by `step` after each successful interval.

    An interval is successful if, over the episodes that ended in it, the survival rate exceeds
    `survival`, and the mean of the reward term per step, as a fraction of its weight, exceeds
    `tracking`. An episode survives if it lasts `survival_s`, or the task's whole episode length if
    that is shorter. It falls if it terminates earlier. Shorter episodes that a time-out truncates
    count as neither; training produces them by starting at random points of episodes. Steps are
    counted since the reset.

    Fractions of the configured sizes in use; components that the task lacks are skipped:

        command ranges    command_from + (1 - command_from) d
        pushes            push_from + (1 - push_from) d
        noise             noise_from + (1 - noise_from) d

    If another curriculum term sets a command range, that range becomes the final one.

    Params:
        reward_name: Reward term of positive weight; at most 1 before weighting.
        tracking: Minimum reward, as a fraction of the weight.
        survival: Minimum survival rate.
        survival_s: Time to survive (s).
        step: Increment of d.
        interval: Interval length (environment steps).
        command_name: Velocity command; lin_vel_x, lin_vel_y and ang_vel_z are ramped.
        command_from: Fraction of the command ranges at d = 0.
        event_name: Event with a `velocity_range`.
        push_from: Fraction of the pushes at d = 0.
        noise_group: Observation group whose noise is ramped.
        noise_from: Fraction of the noise at d = 0.

    Returns d.

    Raises, when built: `ValueError` for a reward term that does not exist or whose weight is not
    positive, and for unsupported noise.
    """

    # Derived from the config; not checkpointed.
    _transient = {"_pushes", "_noises"}

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        name = cfg.params["reward_name"]
        weight = env.reward_manager.get_term_cfg(name).weight
        if not weight > 0.0:
            raise ValueError(
                f"reward_name: expected a term of positive weight, got {name!r} of weight {weight}."
            )
        self.difficulty = 0.0
        self.last_survival, self.last_tracking = 0.0, 0.0
        self._interval_start = 0
        self._episode_start = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        # Totals of the interval: surviving episodes, falls, reward, steps.
        self._tally = torch.zeros(4, dtype=torch.float64, device=env.device)
        self._command_part = 1.0
        self._ranges = self._command_ranges(cfg.params.get("command_name", "twist"))
        event_name = cfg.params.get("event_name", _PUSH)
        self._pushes: Ranges | None = None
        if env.cfg.events.get(event_name) is not None:
            event = env.event_manager.get_term_cfg(event_name)
            self._pushes = dict(event.params["velocity_range"])
        self._noises = self._noise_cfgs(cfg.params.get("noise_group", "actor"))

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
            if self._is_successful(reward_name, survival, tracking):
                self.difficulty = min(self.difficulty + step, 1.0)
            self._interval_start = env.common_step_counter
        d = self.difficulty
        part = command_from + (1.0 - command_from) * d
        for name, bounds in self._command_ranges(command_name).items():
            if bounds != _scaled(self._ranges[name], self._command_part):
                self._ranges[name] = bounds
            setattr(self._live_ranges(command_name), name, _scaled(self._ranges[name], part))
        self._command_part = part
        if self._pushes is not None:
            part = push_from + (1.0 - push_from) * d
            grown = {axis: _scaled(tuple(bounds), part) for axis, bounds in self._pushes.items()}
            env.event_manager.get_term_cfg(event_name).params["velocity_range"] = grown
        part = noise_from + (1.0 - noise_from) * d
        for noise, sizes in self._noises:
            for name, size in sizes.items():
                setattr(noise, name, _scaled(size, part))
        return d

    def reset(self, env_ids: torch.Tensor | slice | None) -> None:
        """Start to count steps, also in resets that hold the curriculum."""
        self._episode_start[slice(None) if env_ids is None else env_ids] = (
            self._env.common_step_counter
        )

    def _count(self, env_ids: torch.Tensor | slice, reward_name: str, survival_s: float) -> None:
        """Count the episodes that end. Resets around an evaluation have no steps and count nothing."""
        env = self._env
        steps = env.common_step_counter - self._episode_start[env_ids]
        min_steps = math.ceil(min(survival_s, env.max_episode_length_s) / env.step_dt - 1e-6)
        survived = steps >= min_steps
        has_moved = steps > 0
        fell = env.termination_manager.terminated[env_ids] & has_moved & ~survived
        reward = env.reward_manager.episode_sum(reward_name)[env_ids] * has_moved
        self._tally += torch.stack(
            [part.sum().double() for part in (survived, fell, reward, steps)]
        )

    def _is_successful(self, reward_name: str, survival: float, tracking: float) -> bool:
        """Return True for a successful interval, and clear its totals."""
        env = self._env
        survived, fell, reward, steps = self._tally.tolist()
        self._tally.zero_()
        unit = env.step_dt if env.cfg.scale_rewards_by_dt else 1.0
        weight = env.reward_manager.get_term_cfg(reward_name).weight
        self.last_survival = survived / max(survived + fell, 1.0)
        self.last_tracking = reward / (max(steps, 1.0) * unit * weight) if weight > 0.0 else 0.0
        return self.last_survival > survival and self.last_tracking > tracking

    def _command_ranges(self, command_name: str) -> Ranges:
        if self._env.cfg.commands.get(command_name) is None:
            return {}
        ranges = self._live_ranges(command_name)
        return {name: tuple(getattr(ranges, name)) for name in _COMMAND_RANGES}

    def _live_ranges(self, command_name: str) -> Any:
        return vars(self._env.command_manager.get_term_cfg(command_name))["ranges"]

    def _noise_cfgs(self, group: str) -> list[tuple[NoiseCfg, dict[str, Any]]]:
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
                        f"{group}/{name} noise: expected additive constant, Gaussian or uniform noise, "
                        f"got {part!r}; use another noise_group to keep this noise unchanged."
                    )
                noises.append((part, {f: getattr(part, f) for f in _NOISE_SIZES[type(part)]}))
        return noises


def _scaled(size: Any, factor: float) -> Any:
    """Return a number, or each number of a tuple, times `factor`."""
    return tuple(factor * s for s in size) if isinstance(size, tuple) else factor * size
