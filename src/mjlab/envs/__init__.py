"""Environments: the manager-based RL environment, its config, and reusable MDP terms in `mdp`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv as ManagerBasedRlEnv
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnvCfg as ManagerBasedRlEnvCfg
    from mjlab.envs.types import VecEnvObs as VecEnvObs
    from mjlab.envs.types import VecEnvStepReturn as VecEnvStepReturn

_LAZY = {
    "ManagerBasedRlEnv": "mjlab.envs.manager_based_rl_env",
    "ManagerBasedRlEnvCfg": "mjlab.envs.manager_based_rl_env",
    "VecEnvObs": "mjlab.envs.types",
    "VecEnvStepReturn": "mjlab.envs.types",
}

# Task configs need only the config class; the environment is imported when one is built.
__getattr__ = lazy_names(__name__, _LAZY)
