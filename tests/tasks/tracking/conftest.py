"""Environments of motion tracking, made small and closed in the end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from tracking_tasks import task_cfg

from mjlab.envs import ManagerBasedRlEnv

EnvFactory = Callable[..., ManagerBasedRlEnv]


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments; arguments are those of `task_cfg`."""
    built: list[ManagerBasedRlEnv] = []

    def make(*args: Any, **kwargs: Any) -> ManagerBasedRlEnv:
        env = ManagerBasedRlEnv(task_cfg(*args, **kwargs), device="cpu")
        built.append(env)
        return env

    yield make
    for env in built:
        env.close()
