"""Event manager: changes of state or model at startup, at resets, at intervals or every step."""

from __future__ import annotations

import functools
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

import torch

from mjlab.compat import accepts_older_fields, offers_older_attributes
from mjlab.managers.debug_vis import TermFunctionSwitches
from mjlab.managers.manager_base import ManagerTermBaseCfg, TermListManager
from mjlab.sim.engine import FIXED_CONSTANTS, INERTIAL_CONSTANTS
from mjlab.sim.randomization import RecomputeLevel
from mjlab.utils.errors import check_one_of
from mjlab.utils.indexing import as_ids, is_empty
from mjlab.utils.lab_api.math import sample_uniform

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


F = TypeVar("F", bound=Callable[..., Any])
EventMode = Literal["startup", "reset", "interval", "step"]
_MODES = get_args(EventMode)

# Timers count down in steps; rounding must not delay an event by one step.
_TIMER_TOLERANCE = 1e-6

# Step of the last event in environments without one, early enough to be always due.
_NEVER = -(2**40)


@accepts_older_fields
@dataclass(kw_only=True)
class EventTermCfg(ManagerTermBaseCfg):
    """Event term configuration: `func(env, env_ids, **params)`; `env_ids` None: all environments."""

    mode: EventMode
    """Trigger: once at `startup`, at each `reset`, at an `interval`, or every `step`."""

    interval_range_s: tuple[float, float] | None = None
    """Range of the time between two events of mode `interval` (s), nonnegative."""

    is_global_time: bool = False
    """Mode `interval`: share one timer, not reset with episodes, among all environments."""

    min_step_count_between_reset: int = 0
    """Mode `reset`: minimum number of environment steps between two events in an environment.
    0: every reset."""


@offers_older_attributes
class EventManager(TermFunctionSwitches, TermListManager):
    """Triggers events and recomputes the model constants that depend on their changes.

    Raises `ValueError` for mode "interval" without `interval_range_s`.
    """

    _title = "events"
    _cfg_type = EventTermCfg
    _shown = {"mode": "mode", "interval (s)": "interval_range_s"}
    _leading = ("env", "env_ids")
    _transient = {"_terms_by_mode"}

    def __init__(self, cfg: Mapping[str, EventTermCfg | None], env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        self._terms_by_mode: dict[str, list[tuple[str, EventTermCfg]]] = {}
        # Time left (s): (num_envs,), or a number for a global timer.
        self._timers: dict[str, torch.Tensor | float] = {}
        # Environment step of the last event, (num_envs,) int64.
        self._last_reset_step: dict[str, torch.Tensor] = {}
        for name, term in zip(self._term_names, self._term_cfgs, strict=True):
            self._terms_by_mode.setdefault(term.mode, []).append((name, term))
            if term.mode == "reset":
                never = torch.full((self.num_envs,), _NEVER, dtype=torch.long, device=self.device)
                self._last_reset_step[name] = never
            if term.mode == "interval":
                bounds = term.interval_range_s
                if bounds is None:
                    raise ValueError(
                        f"{self._label(name)} interval_range_s: expected (shortest, longest) in "
                        "seconds, got None."
                    )
                shortest, longest = bounds
                if not 0.0 <= shortest <= longest:
                    warnings.warn(
                        f"{self._label(name)} interval_range_s: expected (shortest, longest) in "
                        f"seconds with 0 <= shortest <= longest, got {bounds!r}; times below 0 fire at "
                        "every step, NaN never fires.",
                        UserWarning,
                        stacklevel=2,
                    )
                if term.is_global_time:
                    # Sampled on the host: reading a GPU sample would synchronize.
                    self._timers[name] = self._sample_interval(term, 1, "cpu").item()
                else:
                    self._timers[name] = self._sample_interval(term, self.num_envs)

    @property
    def active_terms(self) -> dict[str, list[str]]:  # ty: ignore[incompatible-property-override]
        """Names of the events by mode. Modes without events are left out."""
        return {mode: [name for name, _ in terms] for mode, terms in self._terms_by_mode.items()}

    @property
    def available_modes(self) -> list[str]:
        """Modes with events."""
        return list(self._terms_by_mode)

    @property
    def domain_randomization_fields(self) -> tuple[str, ...]:
        """Model fields that need per-environment values, without duplicates."""
        fields = (
            field for cfg in self._term_cfgs for field in getattr(cfg.func, "model_fields", ())
        )
        return tuple(dict.fromkeys(fields))

    @property
    def recompute_level(self) -> RecomputeLevel:
        """Recompute level that covers all events."""
        return combined_level(self._term_cfgs)

    def apply(
        self,
        mode: EventMode,
        env_ids: torch.Tensor | slice | None = None,
        dt: float | None = None,
        global_env_step_count: int | None = None,
    ) -> None:
        """Trigger the events of `mode` that are due, then recompute the constants they affect.

        After resets, constants are recomputed only for the environments that were reset: on the
        native engine recomputing costs more than a substep per environment.

        Args:
            mode: One of "startup", "reset", "interval" and "step".
            env_ids: Environments that reset; required for "reset", not allowed for "interval".
            dt: Time since the last call (s); required for "interval" and "step".
            global_env_step_count: Environment steps since the start; required for "reset".

        Raises `ValueError` for a missing or disallowed argument, or an unknown mode.
        """
        if mode not in _MODES:
            check_one_of("Event mode", mode, _MODES)
        if mode in ("interval", "step") and dt is None:
            raise ValueError(f"Event mode {mode!r}: expected dt, the time since the last call (s).")
        if mode == "interval" and env_ids is not None:
            raise ValueError(
                "Event mode 'interval': env_ids must be None; every environment has a timer."
            )
        if mode == "reset" and (env_ids is None or global_env_step_count is None):
            raise ValueError(
                "Event mode 'reset': expected env_ids, the environments that reset, and "
                "global_env_step_count, the number of environment steps so far."
            )
        fired, reset_ids = [], None
        if mode == "reset":
            reset_ids = as_ids(env_ids, self.num_envs, self.device)
        for name, cfg in self._terms_by_mode.get(mode, ()):
            due = env_ids
            if mode == "interval":
                due = self._advance_timer(name, cfg, dt or 0.0)
            elif reset_ids is not None:
                due, last, step = reset_ids, self._last_reset_step[name], global_env_step_count or 0
                if cfg.min_step_count_between_reset > 0:
                    due = due[step - last[due] >= cfg.min_step_count_between_reset]
                last[due] = step
            if not is_empty(due):
                cfg.func(self._env, due, **cfg.params)
                fired.append(cfg)
        if fired and (level := combined_level(fired)) != RecomputeLevel.none:
            self._env.sim.recompute_constants(level, reset_ids)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> dict[str, Any]:
        """Reset terms of all modes and resample the timers of `env_ids`. Logs nothing."""
        super().reset(env_ids)
        if self._timers and not is_empty(env_ids):
            ids = as_ids(env_ids, self.num_envs, self.device)
            for name, cfg in self._terms_by_mode["interval"]:
                timer = self._timers[name]
                if isinstance(timer, torch.Tensor):
                    timer[ids] = self._sample_interval(cfg, len(ids))
        return {}

    def _advance_timer(self, name: str, cfg: EventTermCfg, dt: float) -> torch.Tensor | None:
        """Return the environments with an event due, and restart their timers. None: all."""
        timer = self._timers[name]
        if not isinstance(timer, torch.Tensor):
            timer -= dt
            if timer >= _TIMER_TOLERANCE:
                self._timers[name] = timer
                return torch.empty(0, dtype=torch.long)
            self._timers[name] = self._sample_interval(cfg, 1, "cpu").item()
            return None
        timer.sub_(dt)
        ids = (timer < _TIMER_TOLERANCE).nonzero().flatten()
        if len(ids) > 0:
            timer[ids] = self._sample_interval(cfg, len(ids))
        return ids

    def _prepare_terms(self) -> None:
        for name, cfg in self.cfg.items():
            if getattr(cfg, "mode", "step") not in _MODES:
                warnings.warn(
                    f"{self._label(name)} mode: expected one of {_MODES}, got "
                    f"{cfg.mode!r}; the event never happens.",
                    UserWarning,
                    stacklevel=2,
                )
        super()._prepare_terms()

    def _sample_interval(
        self, cfg: EventTermCfg, count: int, device: str | None = None
    ) -> torch.Tensor:
        return sample_uniform(*(cfg.interval_range_s or (0.0, 0.0)), count, device or self.device)


# Model fields that events declare.


def requires_model_fields(
    *fields: str, recompute: RecomputeLevel = RecomputeLevel.none
) -> Callable[[F], F]:
    """Declare the model fields that a function or class changes when used as an event.

    These fields, and the fields derived from them at level `recompute`, are expanded to
    per-environment values. Derived fields are recomputed after the event.
    """

    def declare(function: F) -> F:
        declared = dict.fromkeys((*fields, *derived_fields(recompute)))
        setattr(function, "model_fields", tuple(declared))  # noqa: B010
        setattr(function, "recompute", RecomputeLevel(recompute))  # noqa: B010
        return function

    return declare


def derived_fields(level: RecomputeLevel) -> tuple[str, ...]:
    """Return the model fields recomputed at `level`."""
    fixed = FIXED_CONSTANTS if level & RecomputeLevel.set_const_fixed else ()
    return (*fixed, *(INERTIAL_CONSTANTS if level & RecomputeLevel.set_const_0 else ()))


def combined_level(cfgs: Iterable[EventTermCfg]) -> RecomputeLevel:
    """Return the recompute level that covers all events of `cfgs`."""
    levels = (getattr(cfg.func, "recompute", RecomputeLevel.none) for cfg in cfgs)
    return RecomputeLevel(functools.reduce(operator.or_, levels, 0))
