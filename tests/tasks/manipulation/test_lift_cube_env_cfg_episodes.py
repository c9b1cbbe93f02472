"""The tasks as a whole: a cube that can be lifted, and both engines."""

from __future__ import annotations

import pytest
import torch
from lifting_tasks import DEPTH, LIFT, MULTI, lifting, move, task_cfg
from scripted_arm import OPEN, SHUT, ScriptedArm

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.manipulation.config.yam.rl_cfg import at_goal, placed_at_goal, position_error


def in_front(cfg) -> None:
    """Put the cube straight ahead, its sides along the axes, and the goal above the base's front."""
    command = cfg.commands["lift_height"]
    command.difficulty = "fixed"
    command.resampling_time_range = (30.0, 30.0)
    where = command.object_pose_range
    where.x, where.y, where.z, where.yaw = (0.3, 0.3), (0.0, 0.0), (0.02, 0.02), (0.0, 0.0)


def test_a_scripted_arm_lifts_the_cube_to_its_goal_and_holds_it_there(make_env):
    env = make_env(edit=in_front, num_envs=1)
    env.reset()
    arm = ScriptedArm(env)
    x, y, _ = env.scene.env_origins[0].tolist()
    assert (x, y) == (0.0, 0.0)
    arm.go((0.3, 0.0, 0.12), OPEN, 60, down=True)
    arm.go((0.3, 0.0, 0.02), OPEN, 50, down=True)
    assert not placed_at_goal(env).any()
    arm.go((0.3, 0.0, 0.02), SHUT, 40, down=True)
    arm.go((0.3, 0.0, 0.2), SHUT, 60, down=True)
    arm.go((0.4, 0.0, 0.3), SHUT, 150, down=False)
    # Nothing has ended the episode meanwhile.
    assert env.episode_length_buf.tolist() == [360]
    assert position_error(env)[0] < 0.04
    assert placed_at_goal(env).all()
    assert at_goal(env).tolist() == lifting(env).episode_success.tolist() == [1.0]
    rate = dict(
        zip(env.reward_manager.active_terms, env.reward_manager._step_reward[0], strict=True)
    )
    assert rate["lift"] > 1.5


def test_a_cube_that_is_not_touched_comes_to_rest_on_the_ground(make_env):
    env = make_env(num_envs=8)
    env.reset()
    for _ in range(60):
        env.step(torch.zeros(8, 7))
    assert (lifting(env).metrics["object_height"] - 0.02).abs().max() < 1e-3
    assert env.scene["cube"].data.root_link_vel_w.abs().max() < 1e-2


def terms_on(engine: str, task: str, steps: int) -> dict[str, torch.Tensor]:
    """Return each reward term at every step, with the same random numbers on every engine."""
    cfg = task_cfg(task, num_envs=3, images=False)
    cfg.sim.engine = engine
    # New goals within these steps, so that forward passes of some environments are part of it.
    cfg.commands["lift_height"].resampling_time_range = (0.03, 0.05)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    try:
        env.reset()
        rates = []
        for step in range(steps):
            move(env, 1, seed=step)
            rates.append(env.reward_manager._step_reward.clone())
        assert (lifting(env).command_counter > 1).any()
        names = env.reward_manager.active_terms
        return {name: torch.stack(rates)[..., k] for k, name in enumerate(names)}
    finally:
        env.close()


@pytest.mark.parametrize("task", [LIFT, pytest.param(MULTI, marks=pytest.mark.slow)])
def test_both_engines_give_the_same_rewards_term_by_term(task):
    native, warp = (terms_on(engine, task, steps=4) for engine in ("native", "warp"))
    assert native.keys() == warp.keys()
    for name in ("lift", "lift_precise", "action_rate_l2", "joint_vel_hinge"):
        assert native[name].any(), name
    for name, value in native.items():
        torch.testing.assert_close(warp[name], value, atol=2e-3, rtol=2e-2, msg=name)


@pytest.mark.slow
def test_both_engines_see_the_same_depth():
    images = []
    for engine in ("native", "warp"):
        cfg = task_cfg(DEPTH, num_envs=3)
        cfg.sim.engine = engine
        env = ManagerBasedRlEnv(cfg, device="cpu")
        env.reset()
        move(env, 3)
        images.append(env.step(torch.zeros(3, 7))[0]["camera"].clone())
        env.close()
    difference = (images[0] - images[1]).abs()
    # Away from edges, since edge pixels may show either side.
    assert (difference < 2e-3).float().mean() > 0.97
