"""Curriculum state: what outlives episodes, for another number of environments as well.

Curricula keep their memory in step counters, term configs (weights, parameters, command ranges),
attributes of terms and of the environment, settings such as the episode length, and terrain levels.
Of attributes and settings, only changes since the first reset are kept, so that those of another
config apply.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.managers.manager_base import NullManager
from mjlab.utils.state import (
    CLASS_KEY,
    SKIP,
    capture_state,
    capture_values,
    is_stateful,
    plain_scalar,
    restore_state,
    restored,
)

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv

COUNTERS = ("common_step_counter", "_sim_step_counter")
MANAGERS = (
    "event_manager",
    "command_manager",
    "action_manager",
    "observation_manager",
    "termination_manager",
    "reward_manager",
    "curriculum_manager",
    "metrics_manager",
)
# Attributes of managers by term. Others are buffers of a step or an episode.
_BY_TERM = ("_class_terms", "_terms", "_timers", "_state")
# Managers whose terms may hold rows that outlive episodes, such as a difficulty per environment.
_WITH_ROWS = ("command_manager", "curriculum_manager")
# Attributes of an environment with plain data that are no memory of curricula.
_OWN_ATTRIBUTES = frozenset(
    {
        *(
            "_acts_between_substeps",
            "_built_state",
            "_command_dts",
            "_device",
            "_holds_common_steps",
        ),
        *("_looks_ahead", "_may_not_start", "_nan_resets", "_pending_reset", "_renderer"),
        *("_renderer_is_open", "_sim_step_counter", "_steps_as_one", "common_step_counter"),
        *("diverged", "episode_length_buf", "extras", "manager_visualizers", "metadata", "obs_buf"),
        *("observes_ends", "observes_failures", "physics_dt", "render_mode", "reset_buf"),
        *("reset_terminated", "reset_time_outs", "reward_buf"),
    }
)
_MISSING = object()


def managers_of(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return the managers with terms, by attribute of `env`."""
    managers = {name: getattr(env, name) for name in MANAGERS}
    return {name: one for name, one in managers.items() if not isinstance(one, NullManager)}


def curriculum_state(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return the curriculum state of `env`, as plain data."""
    changed = _changed(env._built_state or {}, lasting_state(env))
    terrain = env.scene.terrain
    levels = None if terrain is None else terrain.terrain_levels
    return {
        "num_envs": env.num_envs,
        "counters": {name: getattr(env, name) for name in COUNTERS},
        "config_edits": {name: one.config_edits() for name, one in managers_of(env).items()},
        "changed": {} if changed is SKIP else changed,
        "terrain_levels": None if levels is None else levels.clone(),
        "num_terrain_levels": 0 if terrain is None else terrain.max_terrain_level,
    }


def load_curriculum_state(env: ManagerBasedRlEnv, state: dict[str, Any]) -> list[str]:
    """Restore a `curriculum_state` of any number of environments; return the names of parts left out.

    Rows of environments are spread evenly and in order: environment i of M gets row i N div M.
    """
    fit = _Fit(state["num_envs"], env.num_envs)
    for name, value in state["counters"].items():
        setattr(env, name, value)
    for name, manager in managers_of(env).items():
        edits = state["config_edits"].get(name, {})
        manager.apply_config_edits(fit.edits(edits, manager._live_cfgs, name))
        undo = _Fit(env.num_envs, env.num_envs), env._built_state or {}
        for one, part in (undo, (fit, state["changed"])):
            saved = part.get("managers", {}).get(name, {})
            spreads = name in _WITH_ROWS
            restore_state(manager, one.entries(saved, vars(manager), name, spreads, depth=0))
    load_attributes(env, state, fit)
    levels, terrain = state["terrain_levels"], env.scene.terrain
    if levels is not None:
        if terrain is None or state["num_terrain_levels"] != terrain.max_terrain_level:
            fit.left_out.append("terrain levels")
        else:
            current = terrain.terrain_levels
            terrain.set_levels(fit.tensor(levels, current, "terrain levels", spreads=True))
    return fit.left_out


def load_attributes(env: ManagerBasedRlEnv, state: dict[str, Any], fit: _Fit | None = None) -> None:
    """Restore attributes and settings of `env` from a `curriculum_state`.

    Attributes that the saved run had not changed get their values before the first reset, because
    resets of `env` may have changed them.
    """
    attributes = vars(env)
    undo = _Fit(env.num_envs, env.num_envs), env._built_state or {}
    redo = fit or _Fit(state["num_envs"], env.num_envs), state["changed"]
    for one, part in (undo, redo):
        fitted = one.entries(part.get("attributes", {}), attributes, "env", spreads=True)
        attributes |= {name: restored(attributes.get(name), v) for name, v in fitted.items()}
    for name, value in state["changed"].get("settings", {}).items():
        setattr(env.cfg, name, value)


def lasting_state(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return what may be memory of curricula.

    Terms of observations are left out: histories, delays and biases are of an episode.
    """
    scene = env.scene
    parts = (env, scene, *scene.entities.values(), *scene.sensors.values())
    managers = {}
    for name, manager in managers_of(env).items():
        if name != "observation_manager":
            captured = capture_state(manager, generators=False, without=parts)
            managers[name] = {key: value for key, value in captured.items() if key in _BY_TERM}
    attributes = {
        name: value
        for name, value in vars(env).items()
        if name not in _OWN_ATTRIBUTES and not is_stateful(value)
    }
    settings = {name: plain_scalar(value) for name, value in vars(env.cfg).items()}
    return {
        "managers": managers,
        "attributes": capture_values(attributes),
        "settings": {name: value for name, value in settings.items() if value is not SKIP},
    }


class _Fit:
    """Values of a state of `num_saved` environments that fit one of `num_envs`.

    `left_out` has the names of values that do not.
    """

    def __init__(self, num_saved: int, num_envs: int) -> None:
        self.left_out: list[str] = []
        self._num_saved, self._num_envs = num_saved, num_envs

    def edits(
        self, edits: dict[str, Any], live: dict[str, Any], path: str
    ) -> dict[str, dict[str, Any]]:
        """Return the edits of term configs that the configs `live`, by label, can take."""
        fitting: dict[str, dict[str, Any]] = {}
        for label, edit in edits.items():
            if label not in live:
                self.left_out.append(f"{path}.{label}")
                continue
            cfg, where = live[label], f"{path}.{label}"
            fields = {key: getattr(cfg, key) for key in edit if hasattr(cfg, key)}
            self.left_out += [f"{where}.{key}" for key in edit if key not in fields]
            fitting[label] = self.entries({key: edit[key] for key in fields}, fields, where, True)
            params = fitting[label].get("params", {})
            for key in [key for key in params if not _takes(cfg, key)]:
                self.left_out.append(f"{where}.params.{key}")
                del params[key]
        return fitting

    def entries(
        self,
        saved: dict[str, Any],
        live: dict[str, Any],
        path: str,
        spreads: bool = False,
        depth: int = 2,
    ) -> dict[str, Any]:
        """Return the entries of `saved` that fit the attributes or entries `live`.

        Args:
            saved: Captured state.
            live: Values to be replaced.
            path: Name of the whole.
            spreads: Spread rows of environments. Otherwise they are left out, silently.
            depth: 0 for a manager, 1 for its dicts by term: no keys are added to them; 2 for others.
        """
        fitting = {}
        for key, value in saved.items():
            # Terms of the saved run.
            if depth == 1 and key not in live:
                self.left_out.append(f"{path}.{key}")
                continue
            where = path if depth == 0 else f"{path}.{key}"
            fitted = self._value(value, live.get(key, _MISSING), where, spreads, min(depth + 1, 2))
            if fitted is not SKIP:
                fitting[key] = fitted
        return fitting

    def tensor(self, saved: torch.Tensor, live: Any, path: str, spreads: bool) -> Any:
        """Return `saved`, spread if its rows are of environments; SKIP if it does not fit `live`."""
        n, m = self._num_saved, self._num_envs
        shape = tuple(saved.shape)
        expected = tuple(live.shape) if isinstance(live, (torch.Tensor, np.ndarray)) else None
        dims = [dim for dim, size in enumerate(shape[:2]) if size == n]
        if not dims and expected in (None, shape):
            return saved
        if expected == shape and (n != m or n == 1):
            return saved
        for dim in dims:
            if expected == (*shape[:dim], m, *shape[dim + 1 :]) or (expected is None and n > 1):
                rows = torch.arange(m, device=saved.device) * n // m
                return saved.index_select(dim, rows) if spreads else SKIP
        self.left_out.append(path)
        return SKIP

    def _value(self, saved: Any, live: Any, path: str, spreads: bool, depth: int) -> Any:
        if isinstance(saved, torch.Tensor):
            return self.tensor(saved, live, path, spreads)
        if isinstance(saved, (list, tuple)):
            return self._sequence(saved, live, path, spreads)
        if not isinstance(saved, dict):
            if live is _MISSING or isinstance(live, torch.Tensor) or plain_scalar(live) is not SKIP:
                return saved
        elif CLASS_KEY in saved:
            if is_stateful(live) and saved[CLASS_KEY] == type(live).__name__:
                return self.entries(saved, vars(live), path, spreads)
        elif live is _MISSING or live is None:
            return saved
        elif isinstance(live, dict):
            return self.entries(saved, live, path, spreads, depth)
        elif dataclasses.is_dataclass(live):
            # Term configs, such as the ranges of a command.
            return self.entries(saved, vars(live), path, spreads, depth=1)
        self.left_out.append(path)
        return SKIP

    def _sequence(self, saved: Any, live: Any, path: str, spreads: bool) -> Any:
        n, m = self._num_saved, self._num_envs
        length = len(live) if isinstance(live, (list, tuple, deque)) else None
        if not any(isinstance(item, (torch.Tensor, dict)) for item in saved):
            if length == m != n == len(saved):
                return [saved[i * n // m] for i in range(m)] if spreads else SKIP
            return saved
        if length != len(saved):
            self.left_out.append(path)
            return SKIP
        items = [
            self._value(item, one, f"{path}[{i}]", spreads, 2)
            for i, (item, one) in enumerate(zip(saved, live, strict=True))
        ]
        return SKIP if any(item is SKIP for item in items) else items


def _takes(cfg: Any, key: str) -> bool:
    """Return whether a term's function takes the parameter `key`, which curricula may add."""
    if key in cfg.params:
        return True
    try:
        parameters = inspect.signature(cfg.func).parameters.values()
    except (TypeError, ValueError):
        return False
    return any(one.name == key or one.kind is one.VAR_KEYWORD for one in parameters)


def _changed(before: Any, now: Any) -> Any:
    """Return the part of the captured state `now` that differs from `before`; SKIP if none does."""
    if isinstance(before, torch.Tensor) and isinstance(now, torch.Tensor):
        return SKIP if torch.equal(before, now) else now
    if isinstance(before, dict) and isinstance(now, dict):
        parts = {key: _changed(before.get(key, SKIP), value) for key, value in now.items()}
        parts = {key: value for key, value in parts.items() if value is not SKIP}
        if parts and CLASS_KEY in now:
            parts[CLASS_KEY] = now[CLASS_KEY]
        return parts or SKIP
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = zip(before, now, strict=True)
        return SKIP if all(_changed(old, new) is SKIP for old, new in pairs) else now
    if type(before) is type(now) and not isinstance(now, (torch.Tensor, dict, list)):
        return SKIP if before == now else now
    return now
