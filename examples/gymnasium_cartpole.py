"""Cross-entropy search on the swing-up by Gymnasium's interface, one policy per environment.

uv run --extra gymnasium python examples/gymnasium_cartpole.py
"""

import gymnasium
import torch

HIDDEN, ELITES = 16, 32


def train(num_envs: int = 512, iterations: int = 40) -> None:
    # The adapter steps with one thread of torch; this is for the policies.
    torch.set_num_threads(1)
    name = "mjlab.gymnasium:mjlab/Mjlab-Cartpole-Swingup"
    options = {"group": "actor", "clip_actions": 1.0, "tensors": True, "device": "cpu"}
    envs = gymnasium.make_vec(name, num_envs=num_envs, **options)
    inputs = envs.single_observation_space.shape[0]
    mean, std = torch.zeros(HIDDEN * (inputs + 1)), torch.ones(HIDDEN * (inputs + 1))
    for _ in range(iterations):
        weights = mean + std * torch.randn(num_envs, len(mean))
        first, second = weights.split([HIDDEN * inputs, HIDDEN], dim=1)
        returns, ended = torch.zeros(num_envs), torch.zeros(num_envs, dtype=torch.bool)
        observations, _ = envs.reset()
        while not ended.all():
            hidden = torch.tanh(first.view(num_envs, HIDDEN, inputs) @ observations[..., None])
            actions = torch.tanh(second[:, None] @ hidden).squeeze(-1)
            observations, rewards, terminated, truncated, _ = envs.step(actions)
            returns += rewards * ~ended
            ended |= terminated | truncated
        elites = weights[returns.topk(min(ELITES, num_envs)).indices]
        mean, std = elites.mean(0), elites.std(0) + 0.05
        print(f"mean return {returns.mean():.0f}, best {returns.max():.0f}", flush=True)
    envs.close()


if __name__ == "__main__":
    train()
