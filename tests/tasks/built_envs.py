"""Factory of real environments that closes them after the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

EnvFactory = Callable[..., ManagerBasedRlEnv]


def built_envs(task_cfg: Callable[..., ManagerBasedRlEnvCfg]) -> Iterator[EnvFactory]:
    """Yield what builds environments from the arguments of `task_cfg`, after an edit of their
    config."""
    built: list[ManagerBasedRlEnv] = []

    def make(
        *args: Any, edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None, **kwargs: Any
    ) -> ManagerBasedRlEnv:
        cfg = task_cfg(*args, **kwargs)
        if edit is not None:
            edit(cfg)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        built.append(env)
        return env

    yield make
    for env in built:
        env.close()
