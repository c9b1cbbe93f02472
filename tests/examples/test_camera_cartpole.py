"""The swing-up from images: frames, and one iteration of training."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks import registry

EXAMPLE = Path(__file__).parents[2] / "examples" / "camera_cartpole.py"
TASK = "Example-Camera-Cartpole"


@pytest.fixture
def example(monkeypatch):
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    return runpy.run_path(str(EXAMPLE))


def test_the_actor_sees_this_frame_and_the_last(example) -> None:
    cfg = example["env_cfg"]()
    cfg.scene.num_envs, cfg.seed = 2, 1
    env = ManagerBasedRlEnv(cfg, device="cpu")
    first = env.reset()[0]["camera"]
    assert first.shape == (2, 2, 24, 36)
    # Two equal frames after a reset, with the pole and the cart in view.
    torch.testing.assert_close(first[:, 0], first[:, 1])
    assert 3 < first[0, 0].sum() < 100
    second = env.step(torch.ones(2, 1))[0]["camera"]
    torch.testing.assert_close(second[:, 0], first[:, 1])
    # A pixel covers 13 cm, more than the cart moves in a step.
    for _ in range(10):
        last = env.step(torch.ones(2, 1))[0]["camera"]
    assert (last[:, 1] != first[:, 1]).any()
    env.close()


def test_it_trains(example, tmp_path, monkeypatch) -> None:
    sizes = ["--num-envs", "4", "--agent.max-iterations", "1", "--agent.num-steps-per-env", "4"]
    argv = ["mjlab", "train", TASK, *sizes, "--device", "cpu", "--log-root", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", argv)
    example["main"]()
    assert list(tmp_path.glob("camera_cartpole/*/*.onnx"))
