"""PPO of skrl on the swing-up: `uv run --extra skrl python examples/skrl_cartpole.py`."""

import torch
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.skrl import SkrlEnv, with_final_observations
from mjlab.tasks.registry import load_env_cfg

NETWORK = [{"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "elu"}]


def train(num_envs: int = 512, iterations: int = 100) -> None:
    torch.set_num_threads(1)
    cfg = load_env_cfg("Mjlab-Cartpole-Swingup")
    cfg.scene.num_envs, cfg.seed = num_envs, 1
    env = SkrlEnv(ManagerBasedRlEnv(cfg, device="cpu"))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    policy = gaussian_model(**spaces, device="cpu", network=NETWORK, output="ACTIONS")
    value = deterministic_model(**spaces, device="cpu", network=NETWORK, output="ONE")
    agent = with_final_observations(PPO)(
        models={"policy": policy, "value": value},
        memory=RandomMemory(memory_size=32, num_envs=num_envs, device="cpu"),
        cfg=PPO_CFG(rollouts=32, learning_epochs=5, mini_batches=4, discount_factor=0.98),
        **spaces,
        device="cpu",
    )
    trainer = {"timesteps": 32 * iterations, "headless": True, "environment_info": "log"}
    SequentialTrainer(cfg=trainer, env=env, agents=agent).train()


if __name__ == "__main__":
    train()
