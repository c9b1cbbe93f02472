"""Cartpole swing-up solved by PPO of skrl.

    uv run --extra skrl python examples/skrl_swing_up.py --seed 1

Trains until the mean return over 100 episodes, without exploration, is 900 of 1,000.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from typing import Any

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.schedulers.torch import KLAdaptiveLR
from skrl.trainers.torch import StepTrainer
from torch import nn

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.rl.skrl import SkrlEnv, with_final_observations
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"
NUM_ENVS, STEPS = 512, 32
# Episodes of an evaluation, one per environment.
EPISODES = 100


def network(inputs: int, outputs: int) -> nn.Module:
    """Return a small network."""
    return nn.Sequential(
        nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, outputs)
    )


class Policy(GaussianMixin, Model):
    """Gaussian policy with a state-independent standard deviation."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = network(self.num_observations, self.num_actions)
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[torch.Tensor, dict]:
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """Value function."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = network(self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[torch.Tensor, dict]:
        return self.net(inputs["observations"]), {}


def make_env(seed: int, device: str, num_envs: int = NUM_ENVS) -> ManagerBasedRlEnv:
    """Return environments of the task."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    return ManagerBasedRlEnv(cfg, device)


def make_trainer(env: ManagerBasedRlEnv, folder: str) -> tuple[StepTrainer, Policy]:
    """Return a trainer with a PPO agent, and the agent's policy."""
    wrapped = SkrlEnv(env)
    spaces: dict[str, Any] = {
        "observation_space": wrapped.observation_space,
        "action_space": wrapped.action_space,
        "device": env.device,
    }
    policy = Policy(**spaces)
    cfg = PPO_CFG(
        rollouts=STEPS,
        learning_epochs=5,
        mini_batches=4,
        discount_factor=0.98,
        learning_rate=1e-3,
        learning_rate_scheduler=KLAdaptiveLR,
        learning_rate_scheduler_kwargs={"kl_threshold": 0.02},
        grad_norm_clip=1.0,
        value_loss_scale=1.0,
        time_limit_bootstrap=True,
    )
    cfg.experiment.directory = folder
    cfg.experiment.checkpoint_interval = cfg.experiment.write_interval = 0
    agent = with_final_observations(PPO)(
        models={"policy": policy, "value": Value(**spaces)},
        memory=RandomMemory(memory_size=STEPS, num_envs=NUM_ENVS, device=env.device),
        cfg=cfg,
        **spaces,
    )
    trainer_cfg = {
        "headless": True,
        "disable_progressbar": True,
        "environment_info": "log",
        "close_environment_at_exit": False,
    }
    return StepTrainer(env=wrapped, agents=agent, cfg=trainer_cfg), policy


def train(seed: int, device: str = "cpu", max_iterations: int = 300) -> tuple[float, float]:
    """Train until the task is solved; return the last evaluation's mean return, and seconds."""
    # For such small networks, thread synchronization costs more than it gains.
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    env = make_env(seed, device)
    scored = RslRlVecEnvWrapper(make_env(seed + 1000, device, EPISODES))
    with tempfile.TemporaryDirectory() as folder:
        trainer, policy = make_trainer(env, folder)
        begin, result = time.monotonic(), None
        total = max_iterations * STEPS
        for step in range(total):
            trainer.train(timestep=step, timesteps=total)
            if (step + 1) % (5 * STEPS):
                continue
            result = evaluate_policy(scored, lambda observations: policy.net(observations["actor"]))
            seconds = time.monotonic() - begin
            print(
                f"{(step + 1) // STEPS} iterations, {seconds:.0f} s: mean return "
                f"{result.mean_return:.0f}",
                flush=True,
            )
            if result.mean_return >= 900.0:
                break
    for each in (env, scored):
        each.close()
    assert result is not None
    return result.mean_return, time.monotonic() - begin


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    train(args.seed, args.device)
