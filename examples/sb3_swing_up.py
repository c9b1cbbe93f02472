"""Cartpole swing-up solved by PPO of Stable-Baselines3.

    uv run --extra sb3 python examples/sb3_swing_up.py --seed 1

Trains until the mean return over 100 episodes, without exploration, is 900 of 1,000.
"""

from __future__ import annotations

import argparse
import time

import torch
from stable_baselines3 import PPO

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.rl.evaluation import evaluate_policy
from mjlab.rl.sb3 import Sb3VecEnv
from mjlab.tasks.registry import load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"
NUM_ENVS, STEPS = 512, 32
# Episodes of an evaluation, one per environment.
EPISODES = 100


def make_env(seed: int, device: str, num_envs: int = NUM_ENVS) -> ManagerBasedRlEnv:
    """Return environments of the task."""
    cfg = load_env_cfg(TASK)
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    return ManagerBasedRlEnv(cfg, device)


def make_learner(env: ManagerBasedRlEnv, seed: int) -> PPO:
    """Return PPO with settings for many environments: short rollouts, few large batches."""
    return PPO(
        "MlpPolicy",
        Sb3VecEnv(env, clip_actions=1.0),
        n_steps=STEPS,
        batch_size=NUM_ENVS * STEPS // 4,
        n_epochs=5,
        learning_rate=1e-3,
        gamma=0.98,
        max_grad_norm=1.0,
        policy_kwargs={"net_arch": [64, 64], "activation_fn": torch.nn.ELU},
        seed=seed,
        device=env.device,
    )


def train(seed: int, device: str = "cpu", max_iterations: int = 300) -> tuple[float, float]:
    """Train until the task is solved; return the last evaluation's mean return, and seconds."""
    # For such small networks, thread synchronization costs more than it gains.
    torch.set_num_threads(1)
    env = make_env(seed, device)
    scored = RslRlVecEnvWrapper(make_env(seed + 1000, device, EPISODES))
    learner = make_learner(env, seed)
    begin, result = time.monotonic(), None
    for iteration in range(5, max_iterations + 1, 5):
        learner.learn(5 * NUM_ENVS * STEPS, reset_num_timesteps=iteration == 5)
        result = evaluate_policy(
            scored,
            lambda observations: torch.as_tensor(
                learner.predict(observations["actor"].cpu().numpy(), deterministic=True)[0]
            ),
        )
        seconds = time.monotonic() - begin
        print(
            f"{iteration} iterations, {seconds:.0f} s: mean return {result.mean_return:.0f}",
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
