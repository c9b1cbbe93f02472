"""The environment loop, its configuration, and the library of reusable terms in `mdp`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjlab.envs.env_cfg import ManagerBasedRlEnvCfg as ManagerBasedRlEnvCfg
    from mjlab.envs.manager_based_rl_env import ManagerBasedRlEnv as ManagerBasedRlEnv

_LAZY = {
    "ManagerBasedRlEnv": "mjlab.envs.manager_based_rl_env",
    "ManagerBasedRlEnvCfg": "mjlab.envs.env_cfg",
}


def __getattr__(name: str) -> Any:
    # A config needs the config class alone; the environment loads when one is built.
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
