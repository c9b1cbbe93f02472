"""Observations of an image-based student and of its state-based teacher."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lifting_tasks import DEPTH, MULTI, lifting

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.manipulation import mdp
from mjlab.tasks.registry import load_env_cfg


@pytest.fixture(scope="module")
def env():
    """Arms and three cubes, with what a student and its teacher observe."""
    cfg = load_env_cfg(MULTI, profile="student")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 8, 1, "native"
    env = ManagerBasedRlEnv(cfg, device="cpu")
    yield env
    env.close()


def test_the_teacher_observes_the_target_cube(env):
    obs: Any = env.reset()[0]
    cfg = env.observation_manager.get_term_cfg("teacher", "ee_to_cube")
    hand = cfg.params["asset_cfg"]
    of_cubes = [mdp.ee_to_object_distance(env, f"cube_{i}", hand) for i in range(3)]
    target = lifting(env).target_selection
    expected = torch.stack(of_cubes)[target, torch.arange(env.num_envs)]
    torch.testing.assert_close(obs["teacher"][:, 16:19], expected)


def test_the_teacher_observes_what_it_was_trained_with():
    teacher = load_env_cfg("Mjlab-Lift-Cube-Yam").observations["actor"].terms
    for task in (DEPTH, MULTI):
        groups = load_env_cfg(task, profile="student").observations
        assert list(groups["teacher"].terms) == list(teacher)
