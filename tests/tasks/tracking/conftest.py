"""Small environments of motion tracking, closed after each test."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from built_envs import EnvFactory, built_envs
from tracking_tasks import G1, task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.tasks.registry import load_rl_cfg
from mjlab.tasks.tracking.rl import MotionTrackingOnPolicyRunner
from mjlab.utils.random import seed_rng


@pytest.fixture
def make_env() -> Iterator[EnvFactory]:
    """Build environments; arguments are those of `task_cfg`."""
    yield from built_envs(task_cfg)


@pytest.fixture
def make_runner():
    """Build runners of a small policy in small environments, writing to a folder."""
    built = []

    def make(
        log_dir: Path | None = None,
        num_envs=6,
        task=G1,
        motion="squat,wave",
        actor=None,
        distribution=None,
        edit=None,
        **kwargs,
    ) -> MotionTrackingOnPolicyRunner:
        seed_rng(1)
        env_cfg = task_cfg(motion, num_envs=num_envs, task=task, edit=edit)
        env = ManagerBasedRlEnv(env_cfg, device="cpu")
        built.append(env)
        cfg = asdict(load_rl_cfg(task))
        cfg["num_steps_per_env"], cfg["save_interval"] = 4, 100
        for model in ("actor", "critic"):
            cfg[model]["hidden_dims"] = (16,)
        cfg["actor"]["class_name"] = actor or cfg["actor"]["class_name"]
        cfg["actor"]["distribution_cfg"] = distribution or cfg["actor"]["distribution_cfg"]
        cfg["logger"] = kwargs.pop("logger", "tensorboard")
        folder = None if log_dir is None else str(log_dir)
        return MotionTrackingOnPolicyRunner(RslRlVecEnvWrapper(env), cfg, folder, "cpu", **kwargs)

    yield make
    for env in built:
        env.close()
