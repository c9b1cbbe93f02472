"""Real environments of the velocity tasks, made small, and stand-ins for hand-known values."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from built_envs import EnvFactory, built_envs
from velocity_tasks import task_cfg

from mjlab.envs import ManagerBasedRlEnv


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments; arguments are those of `task_cfg`, and `edit`, which edits its config."""
    yield from built_envs(task_cfg)


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
