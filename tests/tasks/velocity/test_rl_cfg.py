"""The `cpu` profiles make velocity tasks easier to learn, and not easier to pass."""

from __future__ import annotations

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.config import RslRlOffPolicyRunnerCfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASKS = [
    f"Mjlab-Velocity-{terrain}-Unitree-{robot}"
    for terrain in ("Flat", "Rough")
    for robot in ("Go1", "G1")
]


@pytest.mark.parametrize("task", TASKS)
def test_contacts_are_simple_in_training(task):
    env_cfg = load_env_cfg(task, profile="cpu")
    assert env_cfg.sim.mujoco.cone == "pyramidal"
    for collision in env_cfg.scene.entities["robot"].collisions:
        dims = (
            collision.condim.values() if isinstance(collision.condim, dict) else [collision.condim]
        )
        assert max(dims) <= 3


@pytest.mark.parametrize("task", [task for task in TASKS if task.endswith("Go1")])
def test_penalties_are_eased_and_nothing_else(task):
    env_cfg, table = load_env_cfg(task, profile="cpu"), load_env_cfg(task)
    eased = {name for name, term in table.rewards.items() if term.weight < 0} | {"air_time"}
    for name, term in table.rewards.items():
        easing = env_cfg.curriculum.get(f"eased_{name}")
        assert (easing is not None) == (name in eased)
        if name in eased - {"air_time"}:
            assert easing.params["first"] == pytest.approx(0.02 * term.weight)


@pytest.mark.parametrize("terrain", ["Flat", "Rough"])
def test_the_humanoid_keeps_its_penalties(terrain):
    task = f"Mjlab-Velocity-{terrain}-Unitree-G1"
    env_cfg, table = load_env_cfg(task, profile="cpu"), load_env_cfg(task)
    for name, term in table.rewards.items():
        if term.weight < 0.0:
            assert env_cfg.rewards[name].weight <= term.weight
    assert isinstance(load_rl_cfg(task, profile="cpu"), RslRlOffPolicyRunnerCfg)
    env_cfg.scene.num_envs = 4
    env_cfg.curriculum["difficulty"].params |= {"interval": 1, "survival": -1.0, "tracking": -1.0}
    env = ManagerBasedRlEnv(env_cfg, device="cpu")
    try:
        env.reset()
        twist = env.command_manager.get_term("twist")
        ranges = [twist.cfg.ranges.lin_vel_x]
        for _ in range(21):
            env.step(torch.zeros(4, env.action_manager.total_action_dim))
            env.reset()
            ranges.append(twist.cfg.ranges.lin_vel_x)
        assert ranges == sorted(ranges, key=lambda bounds: bounds[1])
        assert ranges[-1] == pytest.approx(table.commands["twist"].ranges.lin_vel_x)
    finally:
        env.close()
