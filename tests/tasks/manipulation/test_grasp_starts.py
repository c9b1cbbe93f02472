"""Training starts with the object in the hand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg


def lift(**settings) -> ManagerBasedRlEnv:
    """Return the task under its `cpu` profile, with other settings of the command."""
    cfg = load_env_cfg("Mjlab-Lift-Cube-Yam", profile="cpu")
    cfg.scene.num_envs, cfg.seed = 64, 1
    goal = cfg.commands["lift_height"]
    cfg.commands["lift_height"] = replace(goal, num_postures=100, **settings)
    return ManagerBasedRlEnv(cfg, device="cpu")


def hand_and_cube(env: ManagerBasedRlEnv) -> tuple[torch.Tensor, torch.Tensor]:
    robot = env.scene["robot"]
    site = robot.site_names.index("grasp_site")
    return robot.data.site_pos_w[:, site], env.scene["cube"].data.root_link_pos_w


def test_closing_fingers_hold_objects_that_start_in_the_hand():
    env = lift(in_hand=1.0)
    env.reset()
    hand, cube = hand_and_cube(env)
    assert torch.allclose(hand, cube, atol=1e-5)
    close = torch.zeros(64, 7)
    close[:, 6] = -1.0
    for _ in range(10):
        env.step(close)
    hand, cube = hand_and_cube(env)
    # Open fingers need half a second to close.
    assert ((hand - cube).norm(dim=1) < 0.03).float().mean() > 0.5
    env.close()


def test_other_goals_start_with_the_object_on_the_ground():
    env = lift(in_hand=0.0, elsewhere=0.5)
    env.reset()
    hand, cube = hand_and_cube(env)
    assert (cube[:, 2] <= 0.051).all()
    default = env.scene["robot"].data.default_joint_pos
    moved = (env.scene["robot"].data.joint_pos - default).norm(dim=1) > 0.05
    assert 0.3 < moved.float().mean() < 0.7
    env.close()


def test_a_workspace_out_of_reach_is_an_error():
    with pytest.raises(ValueError, match="expected 100 postures"):
        lift(x=(5.0, 6.0))
