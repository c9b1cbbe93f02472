"""Where the time of an environment step goes: by phase, and by term of each manager.

An environment is timed by wrapping, for a while, the methods that a step calls. Without that
nothing is timed, and nothing costs anything.
"""

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

# Methods of the simulation and the scene that a step calls, and the phase that each belongs to.
_SIMULATION = {
    "step": "physics",
    "forward": "forward",
    "forward_after_reset": "forward",
    "sense": "sense",
    "reset": "reset",
}
_SCENE = {"write_data_to_sim": "actuators", "update": "sensors", "reset": "reset"}
# Methods of each manager that a step calls; the phase is named after the manager.
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
# Methods of terms that are objects, by manager.
_TERM_METHODS = {
    "actions": ("process_actions", "apply_actions", "reset"),
    "commands": ("compute", "reset"),
    "recorders": ("record_pre_reset", "record_post_reset", "record_post_step"),
}


@dataclass
class StepProfile:
    """Seconds spent in environment steps, in sum over all steps.

    What is done within a phase counts for that phase: a `forward` that a command asks for is time of
    the commands. So phases add up to no more than the steps, and the terms of a manager to no more
    than the manager. A sensor that computes its data when it is read counts for the term that reads
    it first.
    """

    num_steps: int = 0
    """Steps that were timed."""
    step_time: float = 0.0
    """Seconds of all steps."""
    phases: dict[str, float] = field(default_factory=dict)
    """Seconds of each phase; those of managers are named after them (`rewards`)."""
    terms: dict[str, dict[str, float]] = field(default_factory=dict)
    """For each manager, the seconds of each of its terms."""

    def milliseconds(self, seconds: float) -> float:
        """Return `seconds` of all steps as milliseconds of one."""
        return 1e3 * seconds / max(self.num_steps, 1)

    def percent(self, seconds: float) -> float:
        """Return `seconds` as a part of all steps, in percent."""
        return 100.0 * seconds / self.step_time if self.step_time else 0.0

    @property
    def other(self) -> float:
        """Seconds of the steps that are of no phase."""
        return max(self.step_time - sum(self.phases.values()), 0.0)


@contextlib.contextmanager
def profiled_steps(env: ManagerBasedRlEnv) -> Generator[StepProfile]:
    """Time the steps that `env` makes within the block, also through wrappers around it.

    On a GPU every part is waited for, so that its time is its own; steps take longer for that. The
    environment is as it was after the block, whichever way that ends.
    """
    stopwatch = _Stopwatch(env.device)
    with contextlib.ExitStack() as undo:
        _Instrumentation(env, stopwatch, undo).install()
        yield stopwatch.profile


class _Stopwatch:
    """Wraps calls so that their time is added to a profile."""

    def __init__(self, device: str) -> None:
        self.profile = StepProfile()
        self._waits = torch.device(device).type == "cuda"
        self._device = device
        self._is_in_step = False
        self._phase: str | None = None
        self._term: str | None = None

    def step(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return `call`, timed as a step."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._is_in_step = True
            begin = self._now()
            try:
                result = call(*args, **kwargs)
            finally:
                self._is_in_step = False
            self.profile.step_time += self._now() - begin
            self.profile.num_steps += 1
            return result

        return timed

    def phase(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return `call`, timed as the phase `name` where it is called by a step itself."""
        seconds = self.profile.phases
        seconds.setdefault(name, 0.0)

        def timed(*args: Any, **kwargs: Any) -> Any:
            if not self._is_in_step or self._phase is not None:
                return call(*args, **kwargs)
            self._phase = name
            begin = self._now()
            try:
                return call(*args, **kwargs)
            finally:
                seconds[name] += self._now() - begin
                self._phase = None

        return timed

    def term(self, phase: str, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return `call`, timed as the term `name` where its manager calls it in its phase."""
        seconds = self.profile.terms.setdefault(phase, {})
        seconds.setdefault(name, 0.0)

        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._phase != phase or self._term is not None:
                return call(*args, **kwargs)
            self._term = name
            begin = self._now()
            try:
                return call(*args, **kwargs)
            finally:
                seconds[name] += self._now() - begin
                self._term = None

        return timed

    def _now(self) -> float:
        if self._waits:
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


class _TimedFunction:
    """Stands in for a term's function: calls it through a stopwatch, and is like it otherwise."""

    def __init__(self, function: Any, timed: Callable[..., Any]) -> None:
        object.__setattr__(self, "_function", function)
        object.__setattr__(self, "_timed", timed)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._timed(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._function, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._function, name, value)


class _Instrumentation:
    """Puts a stopwatch around what a step calls, and registers with `undo` what takes it off."""

    def __init__(
        self, env: ManagerBasedRlEnv, stopwatch: _Stopwatch, undo: contextlib.ExitStack
    ) -> None:
        self._env = env
        self._stopwatch = stopwatch
        self._undo = undo

    def install(self) -> None:
        """Put it around everything."""
        self._replace(self._env, "step", self._stopwatch.step)
        for owner, methods in ((self._env.sim, _SIMULATION), (self._env.scene, _SCENE)):
            for method, phase in methods.items():
                self._replace(owner, method, lambda call, p=phase: self._stopwatch.phase(p, call))
        for phase, (attribute, methods) in _MANAGERS.items():
            manager = getattr(self._env, attribute)
            if isinstance(manager, NullManager):
                continue
            for method in methods:
                self._replace(manager, method, lambda call, p=phase: self._stopwatch.phase(p, call))
            self._install_terms(phase, manager)

    def _install_terms(self, phase: str, manager: Any) -> None:
        if phase == "observations":
            for group in manager._groups.values():
                for term in group.terms.values():
                    self._time_methods(phase, term.label, term, ("compute",))
        elif phase in _TERM_METHODS:
            for name, term in manager._terms.items():
                self._time_methods(phase, name, term, _TERM_METHODS[phase])
            return
        else:
            for name, cfg in zip(manager._term_names, manager._term_cfgs, strict=True):
                self._time_function(phase, name, cfg)
        for name, term in manager._class_terms.items():
            if callable(getattr(term, "reset", None)):
                self._time_methods(phase, name, term, ("reset",))

    def _time_methods(self, phase: str, name: str, term: Any, methods: tuple[str, ...]) -> None:
        for method in methods:
            self._replace(term, method, lambda call: self._stopwatch.term(phase, name, call))

    def _time_function(self, phase: str, name: str, cfg: Any) -> None:
        function = cfg.func
        cfg.func = _TimedFunction(function, self._stopwatch.term(phase, name, function))
        self._undo.callback(setattr, cfg, "func", function)

    def _replace(
        self, owner: Any, name: str, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]
    ) -> None:
        """Put what `wrap` makes of a method of `owner` over it."""
        own = vars(owner)
        if name in own:
            self._undo.callback(setattr, owner, name, own[name])
        else:
            self._undo.callback(delattr, owner, name)
        setattr(owner, name, wrap(getattr(owner, name)))
