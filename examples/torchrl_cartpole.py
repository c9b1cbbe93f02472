"""PPO of TorchRL on the swing-up: `uv run --group learners python examples/torchrl_cartpole.py`."""

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import MJLabEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE


def train(num_envs: int = 512, iterations: int = 100) -> None:
    torch.set_num_threads(1)
    env, size = MJLabEnv("Mjlab-Cartpole-Swingup", num_envs=num_envs, device="cpu"), 32 * num_envs
    net = torch.nn.Sequential(MLP(out_features=2, num_cells=[64, 64]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["actor"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64]), in_keys=["actor"])
    critic(actor(env.reset()))
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    advantage = GAE(gamma=0.98, lmbda=0.95, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for data in Collector(env, actor, frames_per_batch=size, total_frames=iterations * size):
        for _ in range(5):
            advantage(data)
            for batch in data.reshape(-1)[torch.randperm(size)].split(size // 4):
                values = loss(batch)
                optimizer.zero_grad()
                sum(v for name, v in values.items() if name.startswith("loss_")).backward()
                optimizer.step()
        print(f"mean reward {data['next', 'reward'].mean():.3f}", flush=True)


if __name__ == "__main__":
    train()
