"""PPO of Stable-Baselines3 on the swing-up: `uv run --extra sb3 python examples/sb3_cartpole.py`."""

import torch
from stable_baselines3 import PPO

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.sb3 import Sb3VecEnv
from mjlab.tasks.registry import load_env_cfg


def train(num_envs: int = 512, iterations: int = 100) -> None:
    torch.set_num_threads(1)
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed = num_envs, 1
    envs = Sb3VecEnv(ManagerBasedRlEnv(cfg, device="cpu"), clip_actions=1.0)
    learner = PPO(
        "MlpPolicy",
        envs,
        n_steps=32,
        batch_size=8 * num_envs,
        n_epochs=5,
        learning_rate=1e-3,
        gamma=0.98,
        seed=1,
        device="cpu",
        verbose=1,
    )
    learner.learn(iterations * 32 * num_envs)
    envs.close()


if __name__ == "__main__":
    train()
