"""Curriculum state: what outlives episodes, for another number of environments as well.

Curricula keep their memory in step counters, term configs (weights, parameters, command ranges),
attributes of terms and of the environment, settings such as the episode length, and terrain levels.
Of attributes and settings, only changes since the first reset are kept, so that those of another
config apply.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
import math
from collections import deque
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mjlab.managers.manager_base import NullManager, config_items
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
from mjlab.utils.torch import to_device

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv

COUNTERS = ("common_step_counter", "_sim_step_counter", "_stepped_to")
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
_BY_TERM = ("_class_terms", "_terms", "_state")
# Managers whose terms, in other packages, may hold rows that outlive episodes: a difficulty per
# environment.
_WITH_ROWS = ("command_manager", "curriculum_manager")
# Settings that the environment reads at every use.
_SETTINGS = ("episode_length_s",)
# Attributes of an environment with plain data that are no memory of curricula.
_OWN_ATTRIBUTES = frozenset(
    {
        *("_acts_between_substeps", "_built_settings", "_built_state", "_device"),
        *("_holds_common_steps", "_nan_resets", "_pending_reset", "_recorded_fields"),
        *("_renderer", "_renderer_is_open", "_sim_step_counter", "_step_modes", "_stepped_to"),
        *("_steps_as_one", "_term_edits", "common_step_counter", "diverged"),
        *("episode_length_buf", "extras", "manager_visualizers", "metadata", "obs_buf"),
        *("observes_ends", "observes_failures", "physics_dt", "render_mode", "reset_buf"),
        *("reset_terminated", "reset_time_outs", "reward_buf"),
    }
)
_MISSING = object()


def managers_of(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return the managers with terms, by attribute of `env`."""
    managers = {name: getattr(env, name) for name in MANAGERS}
    return {name: one for name, one in managers.items() if not isinstance(one, NullManager)}


def begin(env: ManagerBasedRlEnv) -> None:
    """Record the state before the first reset of `env`, and what each curriculum term edits in it.

    Does nothing if it is recorded. Evaluations leave out terms that only ease training, and with them their edits.
    """
    if env._built_state:
        return
    before = env._built_state = lasting_state(env)

    def record(name: str) -> None:
        nonlocal before
        now = lasting_state(env)
        env._term_edits[name] = _changes(before, now)
        before = now

    env.curriculum_manager.after_term = record


def curriculum_state(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return the curriculum state of `env`, as plain data."""
    begin(env)
    terrain = env.scene.terrain
    levels = None if terrain is None else terrain.terrain_levels
    now = lasting_state(env)
    changed = _changes(env._built_state, now)
    return {
        "num_envs": env.num_envs,
        "counters": {name: getattr(env, name) for name in COUNTERS},
        # Edits of term configs, and the values that they replaced.
        "config_edits": changed.pop("config", {}),
        "config_built": _changes(now["config"], env._built_state["config"]),
        # Attributes and settings.
        "changed": changed,
        "term_edits": env._term_edits,
        "terrain_levels": None if levels is None else levels.clone(),
        "num_terrain_levels": 0 if terrain is None else terrain.max_terrain_level,
    }


def load_curriculum_state(env: ManagerBasedRlEnv, state: dict[str, Any]) -> list[str]:
    """Restore a `curriculum_state` of any number of environments; return the names of parts left out.

    - Rows of environments are spread evenly and in order: environment i of M gets row i N div M.
    - What a curriculum term edits that `env` lacks has the value of the config, and of other terms.
    - Edits of values that the config of `env` sets differently are left out.
    """
    begin(env)
    state = to_device(state, env.device)
    fit = Fit(state["num_envs"], env.num_envs)
    load_counters(env, state)
    changed = {"config": state["config_edits"], **state["changed"]}
    known, own = env.curriculum_manager.active_terms, {}
    gone = {name: edits for name, edits in state["term_edits"].items() if name not in known}
    fit.left_out += [f"curriculum_manager.{name}" for name in gone]
    for edits in gone.values():
        changed = _outside(changed, edits)
    if known and gone:
        # Other terms may edit the same values, as a function of the step.
        _undo(env)
        with nullcontext() if env.scene.terrain is None else env.scene.terrain.levels_held():
            env.curriculum_manager.compute(torch.arange(env.num_envs, device=env.device))
        edited = _changes(env._built_state["config"], _configs(env))
        for edits in gone.values():
            own = _merged(own, _inside(edited, (edits or {}).get("config", {})))
    # Resets of `env` may have changed what the saved run had not changed.
    _undo(env)
    fitting = fit.config_edits(changed.get("config", {}), state["config_built"], env)
    _write_configs(env, _merged(fitting, own))
    _load_terms(env, changed, fit)
    load_attributes(env, changed, fit)
    levels, terrain = state["terrain_levels"], env.scene.terrain
    if levels is not None:
        if terrain is None or state["num_terrain_levels"] != terrain.max_terrain_level:
            fit.left_out.append("terrain levels")
        else:
            current = terrain.terrain_levels
            terrain.set_levels(fit.tensor(levels, current, "terrain levels", spreads=True))
    return list(dict.fromkeys(fit.left_out))


def load_exact_state(env: ManagerBasedRlEnv, state: dict[str, Any]) -> None:
    """Restore configs, attributes and settings in a `curriculum_state` of the same task and size."""
    begin(env)
    fit = Fit(env.num_envs, env.num_envs)
    _write_configs(env, fit.config_edits(state["config_edits"], state["config_built"], env))
    load_attributes(env, state["changed"], fit)


def load_counters(env: ManagerBasedRlEnv, state: dict[str, Any]) -> None:
    """Restore the step counters in the state of an environment."""
    for name in COUNTERS:
        # States of earlier versions lack the last one.
        setattr(env, name, state["counters"].get(name, state["counters"][COUNTERS[0]]))


def load_attributes(env: ManagerBasedRlEnv, changed: dict[str, Any], fit: Fit) -> None:
    """Restore the attributes and settings of `env` in the changes of a `curriculum_state`."""
    attributes = vars(env)
    fitted = fit.entries(changed.get("attributes", {}), attributes, "env", spreads=True)
    attributes |= {name: restored(attributes.get(name), value) for name, value in fitted.items()}
    for name, value in changed.get("settings", {}).items():
        setattr(env.cfg, name, value)


def _load_terms(env: ManagerBasedRlEnv, changed: dict[str, Any], fit: Fit) -> None:
    """Restore the attributes of terms in the changes of a `curriculum_state`."""
    managers = managers_of(env)
    for name, saved in changed.get("managers", {}).items():
        if name in managers:
            spreads = name in _WITH_ROWS
            fitted = fit.entries(saved, vars(managers[name]), name, spreads, depth=0)
            restore_state(managers[name], fitted)


def _undo(env: ManagerBasedRlEnv) -> None:
    """Restore configs, attributes and settings as they were before the first reset."""
    fit = Fit(env.num_envs, env.num_envs)
    _write_configs(env, {})
    _load_terms(env, env._built_state, fit)
    load_attributes(env, env._built_state, fit)


def _configs(env: ManagerBasedRlEnv) -> dict[str, Any]:
    return {
        name: {label: plain_values(cfg) for label, cfg in manager.live_cfgs().items()}
        for name, manager in managers_of(env).items()
    }


def _write_configs(env: ManagerBasedRlEnv, edits: dict[str, Any]) -> None:
    """Restore the configs of terms as they were before the first reset, except for `edits`."""
    built = env._built_state["config"]
    for name, manager in managers_of(env).items():
        for label, cfg in manager.live_cfgs().items():
            undone = _changes(plain_values(cfg), built[name][label])
            write_values(cfg, copy.deepcopy(undone))
            write_values(cfg, edits.get(name, {}).get(label, {}))


def config_as_built(env: ManagerBasedRlEnv) -> Any:
    """Return a copy of the config of `env`, without the edits of commands and settings by curricula."""
    begin(env)
    cfg, built = copy.deepcopy(env.cfg), env._built_state
    undone = _changes(_configs(env), built["config"])
    for section, name in ((cfg.commands, "command_manager"), (cfg.actions, "action_manager")):
        for label, values in undone.get(name, {}).items():
            # Configs of commands and actions are those of the environment, or copies of them.
            write_values(section[label], copy.deepcopy(values))
    for name, value in built["settings"].items():
        setattr(cfg, name, value)
    return cfg


def curricula_in_use(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return the state of the curricula of `env`: what differs from its config, by path.

    Edits of term configs, numbers in public attributes of terms and of the environment, settings, and
    numbers that curriculum terms log (`Curriculum/<term>`), unless they repeat one of these or the
    first one.
    """
    shown: dict[str, Any] = {}
    begin(env)
    changed = _changes(env._built_state, lasting_state(env))
    for name, manager in managers_of(env).items():
        kind = name.removesuffix("_manager")
        section = kind if hasattr(env.cfg, kind) else f"{kind}s"
        for label, edit in changed.get("config", {}).get(name, {}).items():
            shown |= _numbers(edit, f"{section}.{label.replace('/', '.')}")
        if manager is env.curriculum_manager:
            continue
        by_term = changed.get("managers", {}).get(name, {})
        for label, attributes in (
            by_term.get("_class_terms") or by_term.get("_terms") or {}
        ).items():
            shown |= _public_numbers(attributes, f"{section}.{label}")
    shown |= _public_numbers(changed.get("attributes", {}), "env")
    shown |= changed.get("settings", {})
    known = [
        one for value in shown.values() for one in (value if isinstance(value, list) else [value])
    ]
    for label, values in env.curriculum_manager.get_active_iterable_terms(0):
        logged = env._term_edits.get(label, {}).get("managers", {}).get("curriculum_manager", {})
        first = _numbers(logged.get("_state", {}).get(label), label).values()
        if len(values) == 1 and not any(
            math.isclose(values[0], number, rel_tol=1e-5) for number in (*known, *first)
        ):
            shown[f"Curriculum/{label}"] = values[0]
    return shown


def _public_numbers(attributes: Any, path: str) -> dict[str, Any]:
    """Return the numbers in `attributes` whose names have no leading underscore."""
    public = attributes.items() if isinstance(attributes, dict) else ()
    return {
        f"{path}.{key}": value.item() if isinstance(value, torch.Tensor) else value
        for key, value in public
        if not key.startswith("_")
        and (
            isinstance(value, (int, float)) or (isinstance(value, torch.Tensor) and value.ndim == 0)
        )
    }


def _numbers(values: Any, path: str) -> dict[str, Any]:
    """Return numbers, and up to eight numbers in a sequence, in nested dicts, by path."""
    if isinstance(values, dict):
        parts = [_numbers(value, f"{path}.{key}") for key, value in values.items()]
        return {name: number for part in parts for name, number in part.items()}
    if isinstance(values, torch.Tensor):
        values = values.tolist()
    if isinstance(values, (int, float)):
        return {path: values}
    is_short = isinstance(values, (list, tuple)) and 0 < len(values) <= 8
    if is_short and all(isinstance(value, (int, float)) for value in values):
        return {path: list(values)}
    return {}


def lasting_state(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return possible memory of curricula.

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
    settings = {name: plain_scalar(getattr(env.cfg, name)) for name in _SETTINGS}
    return {
        "config": _configs(env),
        "managers": managers,
        "attributes": capture_values(attributes),
        "settings": settings,
    }


class Fit:
    """Values of a state of `num_saved` environments that fit one of `num_envs`.

    `left_out` has the names of values that do not.
    """

    def __init__(self, num_saved: int, num_envs: int) -> None:
        self.left_out: list[str] = []
        self._num_saved, self._num_envs = num_saved, num_envs

    def config_edits(
        self, edits: dict[str, Any], was: dict[str, Any], env: ManagerBasedRlEnv
    ) -> dict[str, Any]:
        """Return the edits of term configs that fit those of `env`.

        Args:
            edits: Edits of the saved run, by manager and label.
            was: Values that they replaced.
            env: Environment with configs of these labels, or some of them.
        """
        fitting: dict[str, Any] = {}
        for name, manager in managers_of(env).items():
            live, built = manager.live_cfgs(), env._built_state["config"][name]
            same = self._as_built(edits.get(name, {}), was.get(name, {}), built, name)
            fitting[name] = self.entries(same, live, name, spreads=True, depth=1)
            for label, edit in fitting[name].items():
                params = edit.get("params", {})
                for key in [key for key in params if not _takes(live[label], key)]:
                    self.left_out.append(f"{name}.{label}.params.{key}")
                    del params[key]
        return fitting

    def _as_built(
        self, edit: dict[str, Any], was: dict[str, Any], built: dict[str, Any], path: str
    ) -> dict[str, Any]:
        """Return the part of `edit` whose values were built alike: others were set on purpose."""
        kept = {}
        for key, value in edit.items():
            before, now = was.get(key), built.get(key)
            if isinstance(value, dict) and isinstance(before, dict) and isinstance(now, dict):
                kept[key] = self._as_built(value, before, now, f"{path}.{key}")
            elif key in was and key in built and changed_part(before, now) is not SKIP:
                self.left_out.append(f"{path}.{key}")
            else:
                kept[key] = value
        return kept

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
                # Rows in terms of this package are of episodes.
                spreads = spreads and not type(live).__module__.startswith("mjlab.")
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
    """Return True if a term's function takes the parameter `key`, which curricula may add."""
    if key in cfg.params:
        return True
    try:
        parameters = inspect.signature(cfg.func).parameters.values()
    except (TypeError, ValueError):
        return False
    return any(one.name == key or one.kind is one.VAR_KEYWORD for one in parameters)


# Nested dicts.


def plain_values(cfg: Any) -> dict[str, Any]:
    """Return a copy of the plain values of a config, as nested dicts by field or key.

    Plain values: numbers, strings, None, tensors, and lists and tuples of plain values.
    """
    values: dict[str, Any] = {}
    for key, value in config_items(cfg) or ():
        if callable(value):
            continue
        plain = _plain(value) if config_items(value) is None else plain_values(value)
        if plain is not SKIP:
            values[key] = plain
    return values


def _plain(value: Any) -> Any:
    """Return a copy of a plain value in exactly the built-in types, or SKIP."""
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, (list, tuple)):
        items = [_plain(item) for item in value]
        if any(item is SKIP for item in items):
            return SKIP
        return items if isinstance(value, list) else tuple(items)
    return plain_scalar(value)


def write_values(cfg: Any, values: dict[str, Any]) -> None:
    """Write a part of `plain_values` into a config."""
    current = dict(config_items(cfg) or ())
    for key, value in values.items():
        if isinstance(value, dict) and config_items(current.get(key)) is not None:
            write_values(current[key], value)
        elif isinstance(cfg, dict):
            cfg[key] = value
        else:
            setattr(cfg, key, value)


def _changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    changed = changed_part(before, now)
    return {} if changed is SKIP else changed


def changed_part(before: Any, now: Any) -> Any:
    """Return the part of the captured state `now` that differs from `before`; SKIP if none does."""
    if isinstance(before, torch.Tensor) and isinstance(now, torch.Tensor):
        return SKIP if torch.equal(before, now) else now
    if isinstance(before, dict) and isinstance(now, dict):
        parts = {key: changed_part(before.get(key, SKIP), value) for key, value in now.items()}
        parts = {key: value for key, value in parts.items() if value is not SKIP}
        if parts and CLASS_KEY in now:
            parts[CLASS_KEY] = now[CLASS_KEY]
        return parts or SKIP
    if type(before) is not type(now):
        return now
    if isinstance(now, (list, tuple)) and len(before) == len(now):
        pairs = zip(before, now, strict=True)
        return SKIP if all(changed_part(old, new) is SKIP for old, new in pairs) else now
    return SKIP if not isinstance(now, (list, tuple)) and before == now else now


def _outside(part: dict[str, Any], mask: dict[str, Any] | None) -> dict[str, Any]:
    """Return the entries of `part` that `mask` lacks; none if `mask` is unknown."""
    kept = {}
    for key, value in part.items() if mask is not None else ():
        if mask is None or key not in mask or key == CLASS_KEY:
            kept[key] = value
        elif isinstance(value, dict) and isinstance(mask[key], dict):
            kept[key] = _outside(value, mask[key])
    return kept


def _inside(part: dict[str, Any], mask: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of `part` that `mask` has."""
    return {
        key: _inside(value, mask[key])
        if isinstance(value, dict) and isinstance(mask[key], dict)
        else value
        for key, value in part.items()
        if key in mask
    }


def _merged(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of both; those of `second` take precedence."""
    both = dict(first)
    for key, value in second.items():
        old = both.get(key)
        is_nested = isinstance(value, dict) and isinstance(old, dict)
        both[key] = _merged(old, value) if is_nested else value
    return both
