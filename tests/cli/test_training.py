"""Environments of training and of its evaluations."""

from __future__ import annotations

import pytest

from mjlab.cli.training import evaluation_env_cfg
from mjlab.managers import RewardTermCfg
from mjlab.runs.policy import make_env
from mjlab.runs.settings import typed_settings
from mjlab.scripts.train import TrainConfig, launch_training, parse_train_flags
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


G1 = "Mjlab-Velocity-Flat-Unitree-G1"
GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"


def test_evaluations_have_the_flags_of_the_run():
    # The weight is that of the profile, and another one is registered.
    flags = [
        "--profile", "cpu", "--env.rewards.action-rate-l2.weight", "-0.5",
        "--env.rewards.linear.weight", "9", "--env.sim.num-threads", "1",
        "--env.rewards.foot-slip", "None",
    ]  # fmt: skip
    cfg = parse_train_flags(G1, flags, "train")
    evaluated = evaluation_env_cfg(G1, cfg, typed_settings(cfg.env, "env", flags))
    registered = load_env_cfg(G1)
    assert registered.rewards["action_rate_l2"].weight == -0.1
    assert evaluated.rewards["action_rate_l2"].weight == -0.5
    assert evaluated.rewards["foot_slip"] is None
    assert evaluated.rewards.keys() == registered.rewards.keys()
    assert evaluated.sim.num_threads == 1
    assert evaluated.terminations.keys() == registered.terminations.keys()
    assert "sank" in cfg.env.terminations.keys() - evaluated.terminations.keys()


def test_evaluations_have_the_changes_of_a_program():
    cfg = TrainConfig.from_task(G1, "cpu")
    cfg.env.rewards["mine"] = RewardTermCfg(func=lambda env: env.reward_buf, weight=1.0)
    cfg.env.scene.entities["robot"].init_state.pos = (0.0, 0.0, 2.0)
    evaluated = evaluation_env_cfg(G1, cfg, {})
    assert evaluated.rewards["mine"].weight == 1.0
    assert evaluated.scene.entities["robot"].init_state.pos == (0.0, 0.0, 2.0)
    assert "alive" not in evaluated.rewards


def test_another_time_between_actions_is_reported(capsys):
    flags = ["--profile", "cpu", "--env.decimation", "2"]
    cfg = parse_train_flags(GO1, flags, "train")
    evaluation_env_cfg(GO1, cfg, typed_settings(cfg.env, "env", flags))
    printed = "".join(capsys.readouterr())
    assert "every 0.01 s in evaluations, and every 0.01333 s in training" in " ".join(
        printed.split()
    )
