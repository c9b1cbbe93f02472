"""Correction of a teacher that knows where the object is."""

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
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 32, 1, "native"
    env = ManagerBasedRlEnv(cfg, device="cpu")
    yield env
    env.close()


def seen(obs: Any) -> torch.Tensor:
    """Return which environments have the target cube in the image, (N,)."""
    return obs["camera"][:, 1].flatten(1).any(dim=1)


def test_the_action_brings_the_cube_into_the_image(env):
    obs: Any = env.reset()[0]
    needed = obs["search"][:, -1] > 0.5
    assert 0 < needed.sum() < len(needed)
    assert seen(obs)[~needed].all()
    for _ in range(60):
        obs = env.step(obs["search"][:, :-1])[0]
    assert (obs["search"][:, -1] == 0.0).all()
    assert seen(obs).all()


def test_a_cube_in_the_hand_is_not_searched_for(env):
    obs: Any = env.reset()[0]
    needed = obs["search"][:, -1] > 0.5
    site = env.scene["robot"].site_names.index("grasp_site")
    hand = env.scene["robot"].data.site_pos_w[:, site]
    command = lifting(env)
    for index, cube in enumerate(command.objects):
        ids = (needed & (command.target_selection == index)).nonzero().flatten()
        pose = torch.cat((hand[ids], torch.tensor([1.0, 0, 0, 0]).expand(len(ids), -1)), dim=1)
        cube.write_root_link_pose_to_sim(pose, env_ids=ids)
    env.sim.forward()
    assert (env.observation_manager.compute()["search"][needed, -1] == 0.0).all()


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
