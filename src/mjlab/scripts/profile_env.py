"""Profile the environment step of a task: `uv run profile-env TASK [flags]`."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.managers.manager_base import NullManager
from mjlab.scripts.cli import run_alias
from mjlab.scripts.devices import resolve_device
from mjlab.scripts.environments import make_env
from mjlab.scripts.policy import (
    PolicyFlags,
    agent_cfg_of,
    env_cfg_of,
    find_checkpoint,
    make_policy,
    parse_policy_flags,
    report_policy,
)
from mjlab.utils.ranges import Count, CountOrZero, Seed
from mjlab.utils.string import counted
from mjlab.utils.torch import threads_for_policy

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv

# Phase of each method of simulation and scene called in a step.
_SIMULATION = {
    "step": "physics",
    "forward": "forward",
    "forward_after_reset": "forward",
    "sense": "sense",
    "reset": "reset",
}
_SCENE = {"write_data_to_sim": "actuators", "update": "sensors", "reset": "reset"}
# Manager methods called in a step, by phase.
_MANAGERS = {
    "actions": ("action_manager", ("process_action", "apply_action", "reset")),
    "terminations": ("termination_manager", ("compute", "reset")),
    "rewards": ("reward_manager", ("compute", "reset")),
    "metrics": ("metrics_manager", ("compute", "compute_substep", "reset")),
    "events": ("event_manager", ("apply", "reset")),
    "curriculum": ("curriculum_manager", ("compute", "reset")),
    "commands": ("command_manager", ("compute", "reset")),
    "observations": ("observation_manager", ("compute", "preview", "reset")),
    "recorders": (
        "recorder_manager",
        ("record_pre_reset", "record_post_reset", "record_post_step"),
    ),
}
# Methods of class-based terms, by manager.
_TERM_METHODS = {
    "actions": ("process_actions", "apply_actions", "reset"),
    "commands": ("compute", "reset"),
    "recorders": ("record_pre_reset", "record_post_reset", "record_post_step"),
}
# Share of the step time (%) above which a term is reported as expensive.
_EXPENSIVE = 5.0


@dataclass
class ProfileConfig(PolicyFlags):
    """Flags of `profile-env`."""

    agent: Literal["zero", "random", "trained"] = "random"
    """Policy: `zero` actions, `random` uniform actions in [-1, 1], or a `trained` policy."""
    num_envs: Count = 1024
    """Number of environments."""
    steps: Count = 100
    """Environment steps to time."""
    warm_up: CountOrZero = 20
    """Environment steps before timing."""
    seed: Seed = 0
    """Seed of states and actions."""
    json: bool = False
    """Print only JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `profile-env`."""
    task, *flags = argv
    cfg = parse_policy_flags(ProfileConfig, flags, task, prog, purpose="train")
    run_profile_env(task, cfg)


def run_profile_env(task: str, cfg: ProfileConfig) -> dict[str, Any]:
    """Time the steps of `task`, print the times, and return them.

    Environments use the training config and start at random episode times, so that resets are as
    frequent as in training.
    """
    device = resolve_device(cfg.device)
    checkpoint = find_checkpoint(task, cfg)
    env_cfg = env_cfg_of(task, cfg, checkpoint, purpose="train")
    report_policy(task, checkpoint, cfg, env_cfg, "train")
    env = make_env(
        task,
        env_cfg,
        device,
        cfg.num_envs,
        cfg.engine,
        seed=cfg.seed,
        agent=agent_cfg_of(task, checkpoint, cfg.profile),
    )
    try:
        policy = make_policy(task, env, cfg.agent, checkpoint, device, cfg.profile)
        lengths = env.episode_length_buf
        env.episode_length_buf = torch.randint_like(lengths, high=env.max_episode_length)
        with torch.inference_mode(), threads_for_policy(policy, cfg.num_envs, device):
            _step(env, policy, cfg.warm_up)
            seconds = _step(env, policy, cfg.steps)
            with profiled_steps(env.unwrapped) as profile:
                _step(env, policy, cfg.steps)
        physics = env.unwrapped.sim.capabilities.description
    finally:
        env.close()
    times = {
        "task": task,
        "num_envs": cfg.num_envs,
        "physics": physics,
        "steps": cfg.steps,
        "step_ms": 1e3 * seconds / cfg.steps,
        **profile_rows(profile),
    }
    print(json.dumps(times, indent=2) if cfg.json else _format_times(times))
    return times


def _step(env: Any, policy: Any, count: int) -> float:
    """Take `count` steps and return the time spent in `env.step` (s)."""
    seconds = 0.0
    for _ in range(count):
        actions = policy(env.get_observations())
        begin = _now(env.device)
        env.step(actions)
        seconds += _now(env.device) - begin
    return seconds


def _now(device: torch.device) -> float:
    """Return the time (s) once `device` has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def profile_rows(profile: StepProfile) -> dict[str, Any]:
    """Return a profile in milliseconds per step and percent of the step, largest first."""

    def row(seconds: float, **names: str) -> dict[str, Any]:
        return {**names, "ms": profile.milliseconds(seconds), "percent": profile.percent(seconds)}

    def sorted_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return sorted(rows, key=lambda row: -row["ms"])

    phases = {**profile.phases, "other": profile.other}
    return {
        "profiled_step_ms": profile.milliseconds(profile.step_time),
        "phases": sorted_rows([row(seconds, name=name) for name, seconds in phases.items()]),
        "terms": sorted_rows(
            [
                row(seconds, manager=manager, name=name)
                for manager, terms in profile.terms.items()
                for name, seconds in terms.items()
            ]
        ),
    }


def _format_times(times: dict[str, Any]) -> str:
    step, profiled = times["step_ms"], times["profiled_step_ms"]
    per_second = times["num_envs"] / (step * 1e-3)
    lines = [
        f"Task     {times['task']}, {counted(times['num_envs'], 'environment')}",
        f"Physics  {times['physics']}",
        f"Step     {step:.3f} ms, {per_second:,.0f} environment steps per second; "
        f"{profiled:.3f} ms while timed in parts, over {times['steps']} steps",
        "",
        *_table(("phase",), [((row["name"],), row) for row in times["phases"]]),
        "",
        *_table(
            ("manager", "term"),
            [((row["manager"], row["name"]), row) for row in times["terms"]],
        ),
        "",
    ]
    expensive = [row for row in times["terms"] if row["percent"] > _EXPENSIVE]
    names = (f"{row['manager']}/{row['name']} ({row['percent']:.1f} %)" for row in expensive)
    if expensive:
        lines.append(f"More than {_EXPENSIVE:g} % of the step: {', '.join(names)}.")
    else:
        lines.append(f"No term takes more than {_EXPENSIVE:g} % of the step.")
    return "\n".join(lines)


def _table(
    header: tuple[str, ...], rows: list[tuple[tuple[str, ...], dict[str, Any]]]
) -> list[str]:
    widths = [
        max(len(names[column]) for names in (header, *(names for names, _ in rows)))
        for column in range(len(header))
    ]

    def line(names: tuple[str, ...], ms: str, percent: str) -> str:
        cells = [f"{name:<{width}}" for name, width in zip(names, widths, strict=True)]
        return "  ".join([*cells, f"{ms:>9}", f"{percent:>6}"])

    lines = [line(header, "ms", "%")]
    return lines + [line(names, f"{row['ms']:.3f}", f"{row['percent']:.1f}") for names, row in rows]


# Timing of methods called in a step.


@dataclass
class StepProfile:
    """Time spent in environment steps (s), summed over all steps.

    Nested calls count for the outer phase: a `forward` called by a command is time of the commands.
    So the sum of phases is at most the step time, and the sum of a manager's terms at most the time of
    the manager. Lazily computed sensor data counts for the first term that reads it.
    """

    num_steps: int = 0
    """Number of timed steps."""
    step_time: float = 0.0
    """Time of all steps (s)."""
    phases: dict[str, float] = field(default_factory=dict)
    """Time of each phase (s). Phases of managers are named after the manager (`rewards`)."""
    terms: dict[str, dict[str, float]] = field(default_factory=dict)
    """Time of each term (s), by manager and term."""

    def milliseconds(self, seconds: float) -> float:
        """Convert `seconds` of all steps to milliseconds per step."""
        return 1e3 * seconds / max(self.num_steps, 1)

    def percent(self, seconds: float) -> float:
        """Return `seconds` in percent of the time of all steps."""
        return 100.0 * seconds / self.step_time if self.step_time else 0.0

    @property
    def other(self) -> float:
        """Step time outside all phases (s)."""
        return max(self.step_time - sum(self.phases.values()), 0.0)


@contextlib.contextmanager
def profiled_steps(env: ManagerBasedRlEnv) -> Generator[StepProfile]:
    """Time the steps of `env` within the block, also those through wrappers.

    On a GPU every part is synchronized to attribute times correctly; this slows down the steps. The
    environment is restored after the block, also on errors.
    """
    with contextlib.ExitStack() as undo:
        yield _StepTimer(env, undo).profile


class _StepTimer:
    """Times the methods called in a step, and registers their restoration in `undo`."""

    def __init__(self, env: ManagerBasedRlEnv, undo: contextlib.ExitStack) -> None:
        self.profile = StepProfile()
        self._device = torch.device(env.device)
        self._undo = undo
        # Running phase and term, () for a step outside all phases; None outside steps.
        self._running: tuple[str, ...] | None = None
        self._replace(env, "step", self.step(env.step))
        for owner, methods in ((env.sim, _SIMULATION), (env.scene, _SCENE)):
            for method, phase in methods.items():
                self._time(owner, method, phase)
        for phase, (attribute, methods) in _MANAGERS.items():
            manager = getattr(env, attribute)
            if not isinstance(manager, NullManager):
                for method in methods:
                    self._time(manager, method, phase)
                self._time_terms(phase, manager)

    def step(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return `call` timed as a step."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._running = ()
            begin = _now(self._device)
            try:
                result = call(*args, **kwargs)
            finally:
                self._running = None
            self.profile.step_time += _now(self._device) - begin
            self.profile.num_steps += 1
            return result

        return timed

    def timed(self, call: Callable[..., Any], *names: str) -> Callable[..., Any]:
        """Return `call` timed as a phase, or as phase and term, if called directly by its caller."""
        *phase, name = names
        seconds = self.profile.terms.setdefault(phase[0], {}) if phase else self.profile.phases
        seconds.setdefault(name, 0.0)
        caller = names[:-1]

        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._running != caller:
                return call(*args, **kwargs)
            self._running = names
            begin = _now(self._device)
            try:
                return call(*args, **kwargs)
            finally:
                seconds[name] += _now(self._device) - begin
                self._running = caller

        return timed

    def _time_terms(self, phase: str, manager: Any) -> None:
        if phase == "observations":
            for group in manager._groups.values():
                for term in group.terms.values():
                    self._time(term, "compute", phase, term.label)
        elif phase in _TERM_METHODS:
            for name, term in manager._terms.items():
                for method in _TERM_METHODS[phase]:
                    self._time(term, method, phase, name)
            return
        else:
            for name, cfg in zip(manager._term_names, manager._term_cfgs, strict=True):
                timed = _TimedFunction(cfg.func, self.timed(cfg.func, phase, name))
                self._replace(cfg, "func", timed)
        for name, term in manager._class_terms.items():
            if callable(getattr(term, "reset", None)):
                self._time(term, "reset", phase, name)

    def _time(self, owner: Any, method: str, *names: str) -> None:
        self._replace(owner, method, self.timed(getattr(owner, method), *names))

    def _replace(self, owner: Any, name: str, value: Any) -> None:
        own = vars(owner)
        if name in own:
            self._undo.callback(setattr, owner, name, own[name])
        else:
            self._undo.callback(delattr, owner, name)
        setattr(owner, name, value)


class _TimedFunction:
    """Proxy of a term's function that is called through a stopwatch."""

    def __init__(self, function: Any, timed: Callable[..., Any]) -> None:
        object.__setattr__(self, "_function", function)
        object.__setattr__(self, "_timed", timed)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._timed(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._function, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._function, name, value)


def main() -> None:
    """Entry point of `profile-env`."""
    run_alias("profile-env")


if __name__ == "__main__":
    main()
