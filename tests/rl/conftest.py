from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def make_runner(tmp_path: Path) -> Callable[..., Any]:
    """Return a function that builds a runner on a new fake environment."""
    from rl_fake_env import FakeEnv, FakeEnvCfg, FakeSceneCfg, runner_cfg

    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper

    def make(
        log_dir: Path | None = None,
        num_envs: int = 8,
        env_cfg: dict | None = None,
        runner_cls: type[MjlabOnPolicyRunner] = MjlabOnPolicyRunner,
        **changes: Any,
    ) -> Any:
        cfg = FakeEnvCfg(scene=FakeSceneCfg(num_envs=num_envs), **(env_cfg or {}))
        env = RslRlVecEnvWrapper(FakeEnv(cfg))
        return runner_cls(env, runner_cfg(**changes), None if log_dir is None else str(log_dir))

    return make
