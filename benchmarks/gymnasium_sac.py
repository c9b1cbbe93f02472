"""The off-policy learner on a standard task, against published curves.

    uv run --with gymnasium python benchmarks/gymnasium_sac.py HalfCheetah-v5 --steps 300000

Published for HalfCheetah (SAC, one environment, an update of 256 transitions for every step): a mean
return of about 10,000 after a million steps (Haarnoja et al., arXiv 1812.05905, figure 1). Here the
same number of updates uses several parallel environments.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from mjlab.rl import MjlabOnPolicyRunner
from mjlab.rl.config import RslRlOffPolicyRunnerCfg, squashed_gaussian
from mjlab.rl.run_logger import IterationStats, TrainingObserver


class GymnasiumVecEnv(VecEnv):
    """Gymnasium environments with the interface of rsl_rl; actions are in (-1, 1)."""

    def __init__(self, name: str, num_envs: int, seed: int) -> None:
        self._envs = gymnasium.make_vec(
            name,
            num_envs=num_envs,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        )
        space: Any = self._envs.single_action_space
        self._scale, self.num_actions = float(space.high[0]), space.shape[0]
        self.num_envs, self.device = num_envs, torch.device("cpu")
        self.max_episode_length = 1000
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.cfg = SimpleNamespace(scale_rewards_by_dt=False)
        self.unwrapped = self
        observations, _ = self._envs.reset(seed=seed)
        self._observations = self._as_tensordict(observations)

    def get_observations(self) -> TensorDict:
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        observations, rewards, ended, cut, info = self._envs.step(actions.numpy() * self._scale)
        self._observations = self._as_tensordict(observations)
        time_outs = torch.from_numpy(cut & ~ended)
        extras: dict[str, Any] = {"time_outs": time_outs}
        if cut.any():
            ids = time_outs.nonzero().flatten()
            final = np.stack([info["final_obs"][i] for i in ids.tolist()])
            extras |= {"final_ids": ids, "final_observations": self._as_tensordict(final)}
        dones = torch.from_numpy(ended | cut).long()
        return self._observations, torch.from_numpy(rewards).float(), dones, extras

    def _as_tensordict(self, observations: np.ndarray) -> TensorDict:
        values = torch.from_numpy(np.asarray(observations, dtype=np.float32)).clone()
        return TensorDict({"actor": values}, batch_size=[len(values)])


class Printer(TrainingObserver):
    """Prints the mean return of the last hundred episodes."""

    def __init__(self, every: int) -> None:
        self._every, self._start = every, time.perf_counter()

    def on_iteration(self, stats: IterationStats) -> None:
        if stats.total_steps // self._every > (stats.total_steps - 1000) // self._every:
            seconds = time.perf_counter() - self._start
            print(
                f"{stats.total_steps:>8} steps {seconds:6.0f} s  return {stats.mean_reward or 0:8.0f}  "
                f"step reward {stats.mean_step_reward:6.2f}",
                flush=True,
            )


def config(seed: int, num_envs: int, iterations: int) -> RslRlOffPolicyRunnerCfg:
    """Return SAC's published settings (Haarnoja et al., table 1), with this learner's critics."""
    cfg = RslRlOffPolicyRunnerCfg(
        seed=seed, num_steps_per_env=1000 // num_envs, max_iterations=iterations
    )
    cfg.obs_groups = {"actor": ("actor",), "critic": ("actor",)}
    for network in (cfg.actor, cfg.critic):
        network.hidden_dims, network.activation = (256, 256), "relu"
    cfg.actor.distribution_cfg = squashed_gaussian(init_std=0.9, log_std_max=2.0)
    algorithm = cfg.algorithm
    algorithm.batch_size, algorithm.num_updates = 256, num_envs
    algorithm.replay_steps, algorithm.learning_starts = 1_000_000 // num_envs, 5000 // num_envs
    algorithm.gamma, algorithm.tau = 0.99, 0.005
    algorithm.policy_delay, algorithm.pessimistic = 1, True
    algorithm.actor_learning_rate = algorithm.critic_learning_rate = 3e-4
    algorithm.weight_decay = algorithm.mean_penalty = 0.0
    algorithm.init_alpha, algorithm.alpha_learning_rate = 0.2, 3e-4
    # The usual target of -1 for each action, of squashed actions.
    algorithm.target_std = 0.3
    return cfg


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", nargs="?", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=300_000)
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    env = GymnasiumVecEnv(args.task, args.num_envs, args.seed)
    cfg = config(args.seed, args.num_envs, args.steps // 1000)
    runner = MjlabOnPolicyRunner(env, asdict(cfg))
    runner.observers.append(Printer(every=10_000))
    runner.learn(cfg.max_iterations)


if __name__ == "__main__":
    main()
