"""Checks of an environment config, made before anything is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp.terminations import time_out

if TYPE_CHECKING:
    from mjlab.envs.env_cfg import ManagerBasedRlEnvCfg


def check_env_cfg(cfg: ManagerBasedRlEnvCfg) -> None:
    """Refuse values that could only fail later.

    Raises:
        ValueError: naming the field, what was given and what is allowed.
    """
    if cfg.scene.num_envs < 1:
        raise ValueError(
            f"scene.num_envs is {cfg.scene.num_envs}; the number of environments has to be at "
            "least 1 (--num-envs 4096, say)."
        )
    if cfg.decimation < 1:
        raise ValueError(f"decimation is {cfg.decimation}; it has to be at least 1.")
    if not cfg.sim.mujoco.timestep > 0:
        raise ValueError(
            f"sim.mujoco.timestep is {cfg.sim.mujoco.timestep}; it has to be positive (seconds)."
        )
    if cfg.episode_length_s < 0:
        raise ValueError(f"episode_length_s is {cfg.episode_length_s}; it cannot be negative.")
    if cfg.episode_length_s == 0:
        names = [
            name
            for name, term in cfg.terminations.items()
            if term is not None and term.func is time_out
        ]
        if names:
            raise ValueError(
                f"episode_length_s is 0, so the termination {names[0]!r} would fire at every step. "
                "Set episode_length_s to the length of an episode in seconds, or remove the term."
            )
