"""Run-time state of a whole environment: capture and restore."""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch

from mjlab.envs.curriculum_state import (
    COUNTERS,
    curriculum_state,
    load_counters,
    load_exact_state,
    managers_of,
)
from mjlab.utils.os import to_plain
from mjlab.utils.setting_paths import OF_THE_MACHINE, is_below
from mjlab.utils.state import capture_state, restore_state, shape_differences
from mjlab.utils.string import counted

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

# Settings that the state does not depend on; `num_envs` and the engine are compared by themselves.
_WITHOUT_EFFECT = (*OF_THE_MACHINE, "viewer", "recorders", "sim.nconmax", "sim.njmax")
_PATH = "<path>"
_BUFFERS = ("episode_length_buf", "_pending_reset", "_nan_resets")


def state_dict(env: ManagerBasedRlEnv) -> dict[str, Any]:
    """Return counters, buffers, physics, scene and managers of `env`."""
    return {
        "num_envs": env.num_envs,
        # Copies of lists of names, or of dicts of such lists.
        "terms": {name: copy.copy(one.active_terms) for name, one in managers_of(env).items()},
        "settings": env._built_settings,
        "terrain": _terrain_fingerprint(env),
        "counters": {name: getattr(env, name) for name in COUNTERS},
        "buffers": {name: getattr(env, name).clone() for name in _BUFFERS},
        "observations": _cloned(env.obs_buf),
        "sim": env.sim.state_dict(),
        "scene": capture_state(env.scene),
        "managers": {name: capture_state(one) for name, one in managers_of(env).items()},
        "curriculum": curriculum_state(env),
    }


def load_state_dict(env: ManagerBasedRlEnv, state: dict[str, Any]) -> None:
    """Restore `state` into an environment built from the same config.

    Raises:
        ValueError: the state belongs to a different task, size or engine; `env` is unchanged.
    """
    _check_fits(env, state)
    load_counters(env, state)
    for name, value in state["buffers"].items():
        getattr(env, name).copy_(value)
    for name, manager in managers_of(env).items():
        restore_state(manager, state["managers"][name])
    load_exact_state(env, curricula_in(state))
    restore_state(env.scene, state["scene"])
    # Physics comes last, because some entity buffers are views of simulation fields.
    env.sim.load_state_dict(state["sim"])
    env.obs_buf = _cloned(state["observations"])


def curricula_in(state: dict[str, Any]) -> dict[str, Any]:
    """Return the `curriculum_state` in a `state_dict`, also of earlier versions."""
    if "curriculum" in state:
        return state["curriculum"]
    # Earlier versions did not tell changed attributes of terms, and what each term edits.
    return {
        **{name: state[name] for name in ("num_envs", "counters", "config_edits")},
        **{"config_built": {}, "changed": {}, "terrain_levels": None, "num_terrain_levels": 0},
        "term_edits": dict.fromkeys(state["terms"].get("curriculum_manager", ())),
    }


def settings_of(cfg: ManagerBasedRlEnvCfg) -> dict[str, str]:
    """Return the settings that the state of an environment depends on, as text by dotted path.

    Terms and entities compute attributes from settings (scales, gains, thresholds). The attributes are
    part of the state, so a state is restored under its own settings only.
    """
    return {
        path: text
        for path, text in _leaves(to_plain(cfg), "")
        if not is_below(path, _WITHOUT_EFFECT)
    }


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    holds_more = isinstance(value, list) and any(isinstance(item, dict) for item in value)
    if holds_more or (isinstance(value, dict) and value):
        for name, item in enumerate(value) if holds_more else value.items():
            yield from _leaves(item, f"{path}.{name}" if path else str(name))
    elif isinstance(value, str) and any(os.path.exists(one) for one in value.split(",")):
        # A resumed run reads the copies in the run folder.
        yield path, _PATH
    else:
        # Memory addresses differ between runs.
        yield path, re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def _check_fits(env: ManagerBasedRlEnv, state: dict[str, Any]) -> None:
    if state["num_envs"] != env.num_envs:
        raise ValueError(
            f"Saved environment state: expected {counted(env.num_envs, 'environment')} as in this run, got "
            f"{state['num_envs']}; resume with --num-envs {state['num_envs']} to continue exactly."
        )
    env.sim.check_state(state["sim"])
    saved, current_terrain = state.get("terrain"), _terrain_fingerprint(env)
    if saved is not None and current_terrain is not None:
        same = saved.shape == current_terrain.shape and torch.allclose(
            saved.cpu(), current_terrain, rtol=1e-6
        )
        if not same:
            raise ValueError(
                "Saved environment state: the terrain differs. Terrain generation depends on the "
                "seed; resume with the seed and the terrain settings of the saved run."
            )
    current = state_dict(env)
    differences = [
        f"{manager}: saved terms {state['terms'].get(manager)}, current {current['terms'].get(manager)}"
        for manager in sorted(state["terms"].keys() | current["terms"].keys())
        if state["terms"].get(manager) != current["terms"].get(manager)
    ]
    differences += shape_differences(state, current)
    if not differences and (settings := state.get("settings")) is not None:
        now = env._built_settings
        differences = [
            f"{path} {now.get(path, 'absent')}, was {settings.get(path, 'absent')}"
            for path in dict.fromkeys((*now, *settings))
            if now.get(path) != settings.get(path)
            and _PATH not in (now.get(path), settings.get(path))
        ]
    if differences:
        more = f"; and {len(differences) - 5} more" if len(differences) > 5 else ""
        raise ValueError(
            "Saved environment state: the task differs: " + "; ".join(differences[:5]) + more + "."
        )


def _terrain_fingerprint(env: ManagerBasedRlEnv) -> torch.Tensor | None:
    """Return numbers that identify a generated terrain; None on a plane.

    The numbers are weighted sums over the terrain's geoms and height fields in the model.
    """
    terrain, model = env.scene.terrain, env.sim.mj_model
    if terrain is None or terrain.terrain_origins is None:
        return None
    is_ground = model.geom_bodyid == model.body("terrain").id
    parts = (model.geom_pos[is_ground], model.geom_size[is_ground], model.hfield_data)
    flat = [torch.as_tensor(part.ravel(), dtype=torch.float64) for part in parts]
    weights = [torch.linspace(1.0, 2.0, len(part), dtype=torch.float64) for part in flat]
    sums = [part @ weight for part, weight in zip(flat, weights, strict=True)]
    return torch.stack([*sums, *(torch.tensor(float(len(part))) for part in flat)])


def _cloned(observations: dict[str, Any]) -> dict[str, Any]:
    return {
        name: value.clone() if isinstance(value, torch.Tensor) else _cloned(value)
        for name, value in observations.items()
    }
