"""A Go1 with a recurrent policy: resumes bit for bit, and plays from its exported file."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.rl.exporter_utils import load_onnx_policy
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"


def make_env() -> RslRlVecEnvWrapper:
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 6, 1, "native"
    # Many episodes, so that memories are forgotten at many ends.
    cfg.episode_length_s = 0.2
    return RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))


def make_runner(folder: Path, kind: str, layers: int = 1) -> MjlabOnPolicyRunner:
    cfg = load_rl_cfg(TASK)
    assert hasattr(cfg, "actor")
    networks: Any = (cfg.actor, cfg.critic)
    for network in networks:
        network.class_name, network.rnn_type, network.rnn_num_layers = "RNNModel", kind, layers
        network.rnn_hidden_dim, network.hidden_dims = 16, (16,)
    cfg.num_steps_per_env, cfg.save_interval = 8, 1
    torch.manual_seed(4)
    return MjlabOnPolicyRunner(make_env(), asdict(cfg), str(folder))


@pytest.mark.parametrize(
    "kind",
    [
        "lstm",
        pytest.param("gru", marks=pytest.mark.slow),
    ],
)
def test_a_resumed_run_continues_bit_for_bit(tmp_path, kind):
    whole = make_runner(tmp_path / "whole", kind)
    whole.learn(4, init_at_random_ep_len=True)
    first = make_runner(tmp_path / "first", kind)
    first.learn(2, init_at_random_ep_len=True)
    torch.manual_seed(99)
    second = make_runner(tmp_path / "second", kind)
    second.load(str(tmp_path / "first" / "model_1.pt"))
    second.learn(4)
    for name in ("actor", "critic"):
        expected, found = (getattr(run.alg, name).state_dict() for run in (whole, second))
        assert all(torch.equal(found[key], value) for key, value in expected.items())
    for runner in (whole, first, second):
        runner.env.close()


@pytest.mark.parametrize(
    ("kind", "layers"),
    [
        ("lstm", 1),
        pytest.param("gru", 2, marks=pytest.mark.slow),
    ],
)
def test_the_exported_policy_acts_as_the_policy_over_many_episodes(tmp_path, kind, layers):
    runner = make_runner(tmp_path, kind, layers)
    runner.learn(2)
    env = runner.env
    exported = load_onnx_policy(next(tmp_path.glob("*.onnx")), env, "cpu")
    trained = runner.get_inference_policy()
    trained.reset()
    observations, _ = env.reset()
    ends = 0
    with torch.inference_mode():
        for _ in range(25):
            actions = trained(observations)
            torch.testing.assert_close(exported(observations), actions, rtol=1e-4, atol=1e-5)
            observations, _, dones, _ = env.step(actions)
            for policy in (trained, exported):
                policy.reset(dones)
            ends += int(dones.sum())
    assert ends >= 12
    # Forgetting at the ends is part of what is evaluated.
    scores = [evaluate_policy(env, policy, 6, seed=3) for policy in (trained, exported)]
    assert scores[0].mean_return == pytest.approx(scores[1].mean_return, rel=1e-4)
    env.close()
