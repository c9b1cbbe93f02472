"""The `cpu` profile makes velocity tasks easier to learn, and not easier to pass."""

from __future__ import annotations

import pytest

from mjlab.tasks.registry import load_env_cfg

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
def test_penalties_are_eased_and_nothing_else(task):
    env_cfg, table = load_env_cfg(task, profile="cpu"), load_env_cfg(task)
    eased = {name for name, term in table.rewards.items() if term.weight < 0} | {"air_time"}
    for name, term in table.rewards.items():
        easing = env_cfg.curriculum.get(f"eased_{name}")
        assert (easing is not None) == (name in eased)
        if name in eased - {"air_time"}:
            assert easing.params["first"] == pytest.approx(0.02 * term.weight)
