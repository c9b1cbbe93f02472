"""Small environments of the manipulation tasks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from built_envs import EnvFactory, built_envs
from lifting_tasks import task_cfg


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments; arguments are those of `task_cfg`, and `edit`, which edits its config."""
    yield from built_envs(task_cfg)
