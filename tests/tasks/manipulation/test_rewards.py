"""Rewards: formulas, and hand and object positions of the same time."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lifting_stand_ins import Object, StandInEnv, lifting_command, multi_cube_command
from lifting_tasks import LIFT, MULTI, lifting, move

from mjlab.managers import SceneEntityCfg
from mjlab.tasks.manipulation import mdp

HAND = SceneEntityCfg("robot", site_ids=[0])


def hand_at(env: StandInEnv, x: float) -> None:
    """Give the stand-in a robot whose one site is at `x` in all environments."""
    site = torch.tensor([x, 0.0, 0.0]).expand(env.num_envs, 1, 3)
    env.scene["robot"] = SimpleNamespace(data=SimpleNamespace(site_pos_w=site))


def expected_stage(e: float, g: float) -> float:
    return math.exp(-(e**2) / 0.2**2) * (1.0 + math.exp(-(g**2) / 0.3**2))


def test_reaching_counts_once_and_bringing_doubles_it():
    env, term = lifting_command()
    hand_at(env, 0.1)
    env.objects["cube"].data.root_link_pos_w[:, 0] = torch.tensor([0.1, 0.1, 0.4, 0.3])
    term.target_pos[:, 0] = torch.tensor([0.1, 0.6, 0.4, 0.2])
    found = mdp.staged_position_reward(env, "lift_height", "cube", 0.2, 0.3, HAND)
    expected = [expected_stage(*pair) for pair in ((0.0, 0.0), (0.0, 0.5), (0.3, 0.0), (0.2, 0.1))]
    assert found.tolist() == pytest.approx(expected, rel=1e-5)
    assert found[0] == 2.0
    found = mdp.bring_object_reward(env, "lift_height", "cube", 0.05)
    expected = [math.exp(-(g**2) / 0.05**2) for g in (0.0, 0.5, 0.0, 0.1)]
    assert found.tolist() == pytest.approx(expected, rel=1e-4)


def test_of_several_cubes_only_the_wanted_one_counts():
    env = StandInEnv(2, one=Object(2, [0]), two=Object(2, [1]))
    _, term = multi_cube_command(env)
    hand_at(env, 0.0)
    term.target_selection[:] = torch.tensor([0, 1])
    term.target_pos[:] = 0.0
    env.objects["one"].data.root_link_pos_w[:, 0] = 0.1
    env.objects["two"].data.root_link_pos_w[:, 0] = 0.3
    found = mdp.multi_cube_staged_position_reward(env, "lift_height", 0.2, 0.3, HAND)
    expected = [expected_stage(0.1, 0.1), expected_stage(0.3, 0.3)]
    assert found.tolist() == pytest.approx(expected, rel=1e-5)
    found = mdp.multi_cube_bring_object_reward(env, "lift_height", 0.05)
    assert found.tolist() == pytest.approx([math.exp(-4.0), math.exp(-36.0)], rel=1e-4)


def test_rewards_pair_hand_and_cube_of_the_same_moment(make_env):
    # The reference pairs the hand of this step with the cube of the one before.
    env = make_env(MULTI, images=False)
    env.reset()
    term = lifting(env)
    site = env.scene["robot"].site_names.index("grasp_site")
    params = env.reward_manager.get_term_cfg("lift").params
    seen: list[torch.Tensor] = []

    def expected() -> torch.Tensor:
        wanted = [env.scene[f"cube_{i}"].data.root_link_pos_w for i in term.target_selection]
        cube = torch.stack([positions[row] for row, positions in enumerate(wanted)])
        hand = env.scene["robot"].data.site_pos_w[:, site]
        e2, g2 = (hand - cube).square().sum(1), (cube - term.target_pos).square().sum(1)
        return torch.exp(-e2 / 0.2**2) * (1 + torch.exp(-g2 / 0.3**2))

    lift = env.reward_manager.get_term_cfg("lift")
    plain = lift.func

    def compared(*args: Any, **kwargs: Any) -> torch.Tensor:
        found = plain(*args, **kwargs)
        seen.append((found - expected()).abs().max())
        return found

    lift.func = compared
    # Cubes that fly, so that a step matters.
    for index in range(3):
        env.scene[f"cube_{index}"].write_root_link_velocity_to_sim(torch.full((4, 6), 2.0))
    move(env, 5)
    assert params["reaching_std"] == 0.2
    assert len(seen) == 5
    assert max(seen) < 1e-6


def test_joints_cost_what_is_above_their_speed():
    velocity = torch.tensor([[0.5, -0.5, 0.2], [0.7, -1.5, 0.4]])
    env: Any = SimpleNamespace(
        device="cpu", scene={"robot": SimpleNamespace(data=SimpleNamespace(joint_vel=velocity))}
    )
    found = mdp.joint_velocity_hinge_penalty(env, 0.5)
    assert found.tolist() == pytest.approx([0.0, 0.2**2 + 1.0**2])
    found = mdp.joint_velocity_hinge_penalty(env, 0.5, SceneEntityCfg("robot", joint_ids=[0, 2]))
    assert found.tolist() == pytest.approx([0.0, 0.2**2])
    # Velocities of the simulation are unchanged.
    assert velocity[1].tolist() == pytest.approx([0.7, -1.5, 0.4])


@pytest.mark.parametrize("task", [LIFT, MULTI])
def test_reward_without_a_hand_is_an_error(make_env, task):
    def edit(cfg):
        del cfg.rewards["lift"].params["asset_cfg"]

    env = make_env(task, edit=edit, images=False)
    env.reset()
    with pytest.raises(ValueError, match="asset_cfg: expected one site .*got 2.*grasp_site"):
        env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))


# The hand on the ground.


@pytest.mark.parametrize(("force", "ends"), [(11.0, True), (9.0, False)])
def test_an_episode_ends_when_the_hand_hits_the_ground_in_any_substep(force, ends):
    history = torch.zeros(3, 1, 4, 3)
    history[1, 0, 2] = torch.tensor([0.0, force, 0.0])
    data = SimpleNamespace(force_history=history, found=torch.ones(3, 1))
    env: Any = SimpleNamespace(scene={"touch": SimpleNamespace(data=data)})
    assert mdp.illegal_contact(env, "touch").tolist() == [False, ends, False]
    data.force_history = None
    assert mdp.illegal_contact(env, "touch").tolist() == [True, True, True]


def test_an_arm_that_pushes_its_hand_into_the_ground_ends_its_episode(make_env):
    env = make_env(num_envs=2)
    env.reset()
    reach_down = torch.zeros(2, 7)
    reach_down[0, 1] = 12.0
    for _ in range(80):
        _, _, terminated, _, _ = env.step(reach_down)
        if terminated.any():
            break
    assert terminated.tolist() == [True, False]
