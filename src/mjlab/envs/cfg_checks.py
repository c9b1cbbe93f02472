"""Warnings about configs whose episodes start, end or change otherwise than they say."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from mjlab.envs.mdp.terminations import time_out
from mjlab.utils.config_fields import check_fields_exist
from mjlab.utils.errors import check_count

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv, ManagerBasedRlEnvCfg


def check_env_cfg(cfg: ManagerBasedRlEnvCfg) -> None:
    """Raise `ValueError` for a decimation below 1; warn of attributes that are no fields."""
    check_fields_exist(type(cfg).__name__, cfg)
    check_count("decimation", cfg.decimation)


def report_odd_times(env: ManagerBasedRlEnv) -> None:
    """Warn of time limits that count as failures, and of events that episodes are too short for."""
    terms = {name: cfg for name, cfg in env.cfg.terminations.items() if cfg is not None}
    limits = [n for n, cfg in terms.items() if cfg.func is time_out]
    failures = [] if env.cfg.is_finite_horizon else [n for n in limits if not terms[n].time_out]
    if failures:
        warnings.warn(
            f"TerminationManager terms {failures} time_out: expected True for a time limit, got False; "
            "episodes that reach it count as failures without bootstrapping. Set time_out=True.",
            UserWarning,
            stacklevel=3,
        )
    if not limits:
        return
    if env.max_episode_length <= 0:
        warnings.warn(
            f"episode_length_s: expected a number > 0 (s), got {env.cfg.episode_length_s!r}; terms "
            f"{limits} end episodes at every step. Set episode_length_s, or remove the terms.",
            UserWarning,
            stacklevel=3,
        )
    longest = env.max_episode_length * env.step_dt
    rare = {
        name: cfg.interval_range_s
        for name, cfg in env.cfg.events.items()
        if cfg is not None and cfg.mode == "interval" and not cfg.is_global_time
        # Resets resample the timers.
        if (cfg.interval_range_s or (0.0,))[0] > longest + 0.5 * env.step_dt
    }
    if rare:
        warnings.warn(
            f"EventManager terms {list(rare)} interval_range_s: expected intervals shorter than the "
            f"episode ({longest:.4g} s), got {list(rare.values())}; timers restart with episodes, so "
            "the events never happen. Use is_global_time=True, or mode='reset'.",
            UserWarning,
            stacklevel=3,
        )


def report_start(env: ManagerBasedRlEnv) -> None:
    """Warn if nothing places the entities at the start of an episode. Commands may place them."""
    moves = (e for e in env.scene.entities.values() if e is not env.scene.terrain)
    if (
        "reset" not in env.event_manager.available_modes
        and not env.command_manager.active_terms
        and any(e.is_articulated or e.is_mocap or not e.is_fixed_base for e in moves)
    ):
        warnings.warn(
            f"{type(env.cfg).__name__} events: expected a term of mode 'reset', got "
            f"{list(env.cfg.events)}; episodes start at the model's qpos0 instead of init_state. "
            "Add EventTermCfg(func=mdp.reset_scene_to_default, mode='reset').",
            UserWarning,
            stacklevel=3,
        )
