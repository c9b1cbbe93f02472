"""Whole episodes of the tasks: both engines, encoder bias, exact resume."""

from __future__ import annotations

import pytest
import torch
from velocity_tasks import GO1_FLAT, GO1_ROUGH, task_cfg

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import list_tasks
from mjlab.tasks.velocity import mdp
from mjlab.utils.random import rng_state, set_rng_state

G1_FLAT = "Mjlab-Velocity-Flat-Unitree-G1"


def walk(env, steps: int, seed: int = 0) -> torch.Tensor:
    """Step with random actions; return the rewards, (steps, N)."""
    generator = torch.Generator().manual_seed(seed)
    shape = (env.num_envs, env.action_manager.total_action_dim)
    actions = [torch.rand(shape, generator=generator) - 0.5 for _ in range(steps)]
    return torch.stack([env.step(action)[1].clone() for action in actions])


def test_all_eight_tasks_are_registered():
    assert {name for name in list_tasks() if "Velocity" in name} == {
        f"Mjlab-Velocity-{ground}-Unitree-{robot}{suffix}"
        for ground in ("Flat", "Rough")
        for robot in ("Go1", "G1")
        for suffix in ("", "-No-State-Estimation")
    }


def test_the_same_seed_gives_the_same_rewards(make_env):
    runs = []
    for _ in range(2):
        env = make_env(GO1_FLAT)
        env.reset()
        runs.append(walk(env, 10))
    assert torch.equal(runs[0], runs[1])


def test_number_of_threads_does_not_matter(make_env):
    runs = []
    for threads in (1, 2):
        env = make_env(GO1_FLAT, edit=lambda c, t=threads: setattr(c.sim, "num_threads", t))
        env.reset()
        runs.append(walk(env, 5))
    assert torch.equal(runs[0], runs[1])


# Logs of a step.


def test_terms_that_are_off_log_nothing_and_the_others_do_at_every_step(make_env):
    env = make_env()
    env.reset()
    walk(env, 1)
    logged = {key for key in env.extras["log"] if key.startswith("Metrics/")}
    # Angular momentum and air time have the weight 0 on the Go1.
    assert logged == {
        "Metrics/peak_height_mean",
        "Metrics/slip_velocity_mean",
        "Metrics/landing_force_mean",
    }


# Encoders.


def test_actions_see_the_bias_of_the_encoders_as_observations_do(make_env):
    env = make_env(num_envs=2)
    env.reset()
    robot, action = env.scene["robot"], env.action_manager.get_term("joint_pos")
    bias = robot.data.encoder_bias
    # Sampled at startup, per joint and environment.
    assert len(bias.unique()) == bias.numel()
    assert bias.abs().max() <= 0.015
    wanted = torch.rand(2, 12) - 0.5
    action.process_actions(wanted)
    action.apply_actions()
    # A robot that has reached its targets observes, by its encoders, what was commanded.
    robot.write_joint_state_to_sim(robot.data.joint_pos_target, torch.zeros(2, 12))
    observed = mdp.joint_pos_rel(env, biased=True)
    scale = env.action_manager.get_term("joint_pos")._scale
    torch.testing.assert_close(observed, wanted * scale, atol=1e-6, rtol=1e-5)
    # The critic observes the true positions.
    true = mdp.joint_pos_rel(env)
    torch.testing.assert_close(true, observed - bias, atol=1e-6, rtol=1e-5)


def test_the_actor_observes_biased_joints_and_the_critic_true_ones(make_env):
    def edit(cfg):
        cfg.observations["actor"].enable_corruption = False

    env = make_env(edit=edit, num_envs=2)
    observations, _ = env.reset()
    joints = slice(9, 21)
    difference = observations["actor"][:, joints] - observations["critic"][:, joints]
    torch.testing.assert_close(difference, env.scene["robot"].data.encoder_bias)


# Both engines.


def terms_on(engine: str, task: str, steps: int) -> dict[str, torch.Tensor]:
    """Return each reward term at every step, with the same random numbers on every engine."""
    cfg = task_cfg(task, num_envs=3)
    cfg.sim.engine = engine
    env = ManagerBasedRlEnv(cfg, device="cpu")
    generator = torch.Generator().manual_seed(0)
    try:
        env.reset()
        rates = []
        for _ in range(steps):
            env.step(
                torch.rand((3, env.action_manager.total_action_dim), generator=generator) - 0.5
            )
            rates.append(env.reward_manager._step_reward.clone())
        names = env.reward_manager.active_terms
        return {name: torch.stack(rates)[..., k] for k, name in enumerate(names)}
    finally:
        env.close()


ENGINE_CASES = [
    GO1_FLAT,
    pytest.param(GO1_ROUGH, marks=pytest.mark.slow),
    pytest.param(G1_FLAT, marks=pytest.mark.slow),
    pytest.param("Mjlab-Velocity-Rough-Unitree-G1", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("task", ENGINE_CASES)
def test_both_engines_give_the_same_rewards_term_by_term(task):
    native, warp = (terms_on(engine, task, steps=4) for engine in ("native", "warp"))
    assert native.keys() == warp.keys()
    assert sum(bool((value != 0.0).any()) for value in native.values()) >= 6
    for name, value in native.items():
        torch.testing.assert_close(warp[name], value, atol=2e-3, rtol=2e-2, msg=name)


# Exact resume.


def test_terrain_levels_and_command_ranges_go_on_in_another_environment(make_env):
    env = make_env(GO1_ROUGH, num_envs=12)
    env.common_step_counter = 150_000
    env.reset()
    walk(env, 2)
    terrain = env.scene.terrain
    terrain.update_env_origins(
        torch.arange(12), torch.arange(12) % 2 == 0, torch.arange(12) % 3 == 0
    )
    terrain.randomize_env_origins(torch.tensor([3, 4]))
    term = env.command_manager.get_term("twist")
    assert term.ranges.lin_vel_x == (-1.5, 2.0)
    # Also what no curriculum sets.
    term.ranges.lin_vel_y = (-0.25, 0.25)
    state, generators = env.state_dict(), rng_state()
    expected = walk(env, 4)
    other = make_env(GO1_ROUGH, num_envs=12)
    assert other.command_manager.get_term("twist").ranges.lin_vel_x == (-1.0, 1.0)
    other.load_state_dict(state)
    set_rng_state(generators)
    for name in ("terrain_levels", "terrain_types", "env_origins"):
        saved = state["scene"]["_terrain"][name]
        assert torch.equal(getattr(other.scene.terrain, name), saved), name
    ranges = other.command_manager.get_term("twist").ranges
    assert (ranges.lin_vel_x, ranges.lin_vel_y) == ((-1.5, 2.0), (-0.25, 0.25))
    assert torch.equal(walk(other, 4), expected)


def test_peaks_errors_and_kinds_of_commands_go_on_too(make_env):
    env = make_env()
    env.reset()
    walk(env, 15)
    state = env.state_dict()
    other = make_env()
    other.reset()
    other.load_state_dict(state)
    one, two = (e.command_manager.get_term("twist") for e in (env, other))
    for name in (
        "vel_command_b",
        "heading_target",
        "is_heading_env",
        "is_standing_env",
        "_samples",
    ):
        assert torch.equal(getattr(one, name), getattr(two, name)), name
    for name in one.metrics:
        assert torch.equal(one.metrics[name], two.metrics[name])
    swings = [e.reward_manager.get_term_cfg("foot_swing_height").func for e in (env, other)]
    assert (swings[0].peak_heights > 0.0).any()
    assert torch.equal(swings[0].peak_heights, swings[1].peak_heights)


def test_environments_do_not_go_on_on_another_terrain(make_env):
    state = make_env(GO1_ROUGH).state_dict()

    def edit(cfg):
        cfg.scene.terrain.terrain_generator.seed += 1

    other = make_env(GO1_ROUGH, edit=edit)
    levels = other.scene.terrain.terrain_levels.clone()
    with pytest.raises(ValueError, match="terrain.*resume with the seed"):
        other.load_state_dict(state)
    assert torch.equal(other.scene.terrain.terrain_levels, levels)
