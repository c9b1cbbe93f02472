"""Profile of environment steps: time by phase and by term."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.manager_base import NullManager

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv

# Phase of each method of simulation and scene called in a step.
_SIMULATION = {
    "step": "physics",
    "forward": "forward",
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
    timer = _StepTimer(env)
    try:
        timer.start(env)
        yield timer.profile
    finally:
        timer.restore()


def device_time(device: torch.device) -> float:
    """Return the time (s) once `device` has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class _StepTimer:
    """Stopwatch of the methods called in a step, from `start` to `restore`."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self.profile = StepProfile()
        self._device = torch.device(env.device)
        # Owner, name and former instance attribute (None: inherited) of each replaced method.
        self._replaced: list[tuple[Any, str, Any]] = []
        # Running phase and term, () for a step outside all phases; None outside steps.
        self._running: tuple[str, ...] | None = None

    def start(self, env: ManagerBasedRlEnv) -> None:
        """Replace the methods by timed ones."""
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
            begin = device_time(self._device)
            try:
                result = call(*args, **kwargs)
            finally:
                self._running = None
            self.profile.step_time += device_time(self._device) - begin
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
            begin = device_time(self._device)
            try:
                return call(*args, **kwargs)
            finally:
                seconds[name] += device_time(self._device) - begin
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
        self._replaced.append((owner, name, vars(owner).get(name)))
        setattr(owner, name, value)

    def restore(self) -> None:
        """Put the methods back."""
        for owner, name, own in reversed(self._replaced):
            if own is None:
                delattr(owner, name)
            else:
                setattr(owner, name, own)


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
