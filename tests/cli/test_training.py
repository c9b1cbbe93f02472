"""Torch is configured before a command trains or plays."""

from __future__ import annotations

import pytest

from mjlab.runs.policy import make_env
from mjlab.scripts.train import TrainConfig, launch_training
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg


@pytest.mark.parametrize("command", ["train", "play"])
def test_training_and_playing_prepare_torch_first(monkeypatch, tmp_path, command):
    class Prepared(Exception):
        pass

    def prepare(device):
        raise Prepared(device)

    for module in ("cli.training", "runs.policy"):
        monkeypatch.setattr(f"mjlab.{module}.prepare_torch", prepare)
    task = "Mjlab-Cartpole-Balance"
    with pytest.raises(Prepared, match="cpu"):
        if command == "train":
            launch_training(
                task,
                TrainConfig(
                    load_env_cfg(task), load_rl_cfg(task), device="cpu", log_root=str(tmp_path)
                ),
            )
        else:
            make_env(task, load_env_cfg(task), "cpu")
