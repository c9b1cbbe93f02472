"""Real environments of the velocity tasks, made small, and stand-ins for hand-known values."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from velocity_tasks import GO1_FLAT, task_cfg

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg

EnvFactory = Callable[..., ManagerBasedRlEnv]


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments, after an edit of their config, and close them in the end."""
    built: list[ManagerBasedRlEnv] = []

    def make(
        task: str = GO1_FLAT,
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


@pytest.fixture(scope="module")
def go1() -> Iterator[ManagerBasedRlEnv]:
    """An environment that tests of a module share; it walks randomly for a few steps."""
    env = ManagerBasedRlEnv(task_cfg(), device="cpu")
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(12):
        env.step(torch.rand(4, 12, generator=generator) - 0.5)
    yield env
    env.close()
