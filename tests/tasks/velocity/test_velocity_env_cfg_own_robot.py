"""Documentation example: the velocity task for a custom robot."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

PAGE = Path(__file__).resolve().parents[3] / "docs" / "guides" / "velocity.md"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the code of the page with the Go1 as custom robot."""
    robots: Any = ModuleType("my_robots")
    robots.FEET, robots.TRUNK = ("FR", "FL", "RR", "RL"), "trunk"
    robots.get_my_robot_cfg = get_go1_robot_cfg
    monkeypatch.setitem(sys.modules, "my_robots", robots)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 5
    namespace: dict[str, Any] = {}
    for block in blocks:
        exec(block, namespace)
    return namespace


@pytest.mark.parametrize("play", [False, True])
@pytest.mark.parametrize("name", ["my_robot_env_cfg", "my_robot_flat_env_cfg"])
def test_the_example_builds_and_steps(example, name, play):
    cfg = example[name](play=play)
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 2, 1, "native"
    if cfg.scene.terrain.terrain_generator:
        cfg.scene.terrain.terrain_generator.num_rows = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    env.reset()
    reward = env.step(torch.zeros(2, 12))[1]
    assert torch.isfinite(reward).all()
    assert (reward > 0.0).all()
    env.close()


def test_the_snippet_about_mirror_images_is_that_of_the_profile(example):
    profile = load_rl_cfg("Mjlab-Velocity-Flat-Unitree-Go1", profile="cpu")
    assert example["rl_cfg"].algorithm.symmetry_cfg == profile.algorithm.symmetry_cfg


def test_the_snippet_mirrors_an_observation_of_its_own(example):
    cfg = load_env_cfg("Mjlab-Lift-Cube-Yam")
    velocity = ObservationTermCfg(func=example["cube_velocity"])
    cfg.observations["actor"].terms["velocity"] = velocity
    env = ManagerBasedRlEnv(cfg, device="cpu")
    obs = TensorDict({"actor": torch.ones(1, 32), "critic": torch.ones(1, 29)}, batch_size=[1])
    image, _ = example["mirror_with_velocity"](env, obs)
    assert image["actor"][1, 29:].tolist() == [1.0, -1.0, 1.0]
    env.close()


def test_the_snippet_about_the_elapsed_time_sets_a_parameter_that_exists(example, make_env):
    term = example["cfg"].curriculum["terrain_levels"]

    def edit(cfg):
        cfg.curriculum["terrain_levels"] = term

    env = make_env("Mjlab-Velocity-Rough-Unitree-Go1", edit=edit, num_envs=2)
    assert env.curriculum_manager.get_term_cfg("terrain_levels").params["use_elapsed_time"]
