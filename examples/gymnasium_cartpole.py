"""PPO by hand on the swing-up: `uv run --extra gymnasium python examples/gymnasium_cartpole.py`."""

import gymnasium
import torch

NAME, GAMMA, LAMBDA = "mjlab.gymnasium:mjlab/Mjlab-Cartpole-Swingup", 0.98, 0.95


def train(num_envs: int = 512, iterations: int = 100) -> None:
    torch.set_num_threads(1)
    envs = gymnasium.make_vec(NAME, num_envs, group="actor", clip_actions=1.0, tensors=True)
    inputs = envs.single_observation_space.shape[0]
    # Mean of the action, and value.
    net = torch.nn.Sequential(torch.nn.Linear(inputs, 128), torch.nn.ELU(), torch.nn.Linear(128, 2))
    optimizer = torch.optim.Adam(net.parameters(), lr=2e-3)
    seen, _ = envs.reset(seed=1)
    for _ in range(iterations):
        steps = []
        for _ in range(32):
            actions = torch.normal(net(seen)[:, :1].detach(), 0.5)
            after, reward, terminated, truncated, infos = envs.step(actions)
            last, ended = after.clone(), terminated | truncated
            for row in ended.nonzero().flatten().tolist():
                last[row] = infos["final_obs"][row]
            steps.append((seen, actions, reward, last, ~terminated, ~ended))
            seen = after
        batch, actions, rewards, last, lives, goes_on = map(torch.stack, zip(*steps, strict=True))
        mean, value = net(batch).detach().unbind(-1)
        gain = rewards + GAMMA * lives * net(last)[..., 1].detach() - value
        for step in reversed(range(31)):
            gain[step] += GAMMA * LAMBDA * goes_on[step] * gain[step + 1]
        target, gain = value + gain, (gain - gain.mean()) / gain.std()
        for _ in range(20):
            new, value = net(batch).unbind(-1)
            ratio = (2.0 * ((actions[..., 0] - mean) ** 2 - (actions[..., 0] - new) ** 2)).exp()
            surrogate = torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain)
            optimizer.zero_grad()
            ((value - target).square().mean() - surrogate.mean()).backward()
            optimizer.step()
        print(f"mean reward {rewards.mean():.3f}", flush=True)


if __name__ == "__main__":
    train()
