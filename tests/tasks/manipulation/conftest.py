"""Real environments of the manipulation tasks, made small."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from lifting_tasks import LIFT, task_cfg

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

EnvFactory = Callable[..., ManagerBasedRlEnv]


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments, after an edit of their config, and close them in the end."""
    built: list[ManagerBasedRlEnv] = []

    def make(
        task: str = LIFT,
        edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None,
        **kwargs: Any,
    ) -> ManagerBasedRlEnv:
        cfg = task_cfg(task, **kwargs)
        if edit is not None:
            edit(cfg)
        env = ManagerBasedRlEnv(cfg, device="cpu")
        built.append(env)
        return env

    yield make
    for env in built:
        env.close()
