"""The `cpu` profile makes velocity tasks easier to learn, and not easier to pass."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest

from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.config.cpu_profile import cpu

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


@pytest.mark.parametrize("task", TASKS)
def test_evaluations_push_as_hard_as_the_task_however_far_training_is(task):
    env_cfg, rl_cfg = load_env_cfg(task), load_rl_cfg(task)
    cpu(env_cfg, rl_cfg)
    env = SimpleNamespace(
        common_step_counter=10,
        event_manager=SimpleNamespace(get_term_cfg=lambda name: env_cfg.events[name]),
    )
    # Training edits the config that evaluations copy.
    growing = env_cfg.curriculum["eased_push_robot"]
    assert 0.0 < growing.func(env, slice(None), **growing.params) < 0.01
    copied = copy.deepcopy(env_cfg)
    rl_cfg.evaluation.prepare_env(copied)
    pushes = load_env_cfg(task).events["push_robot"].params
    assert copied.events["push_robot"].params == pushes


@pytest.mark.parametrize("task", TASKS)
def test_eased_rewards_end_at_the_weights_of_the_task(task):
    env_cfg, table = load_env_cfg(task, profile="cpu"), load_env_cfg(task)
    eased = {name for name, term in table.rewards.items() if term.weight < 0} | {"air_time"}
    for name, term in table.rewards.items():
        if name not in eased:
            assert env_cfg.rewards[name].weight == term.weight
            continue
        stages = env_cfg.curriculum[f"eased_{name}"].params["stages"]
        assert stages[0] == {"step": 0, "weight": env_cfg.rewards[name].weight}
        assert stages[-1]["weight"] == pytest.approx(term.weight)
        weights = [stage["weight"] for stage in stages]
        assert weights == sorted(weights, reverse=True)
