"""Easing of `cpu` profiles: ramps end at the values of the task and of flags."""

from __future__ import annotations

import math

import pytest
import torch
from built_envs import built_envs

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.easing import (
    GrowingDifficulty,
    coarsen_physics,
    grow_difficulty,
)
from mjlab.tasks.registry import load_env_cfg

GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
G1_TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"


def profiled(task: str):
    cfg = load_env_cfg(task, profile="cpu")
    cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 2, 1, "native"
    return cfg


@pytest.fixture
def make_env():
    """Build two environments of a task with its profile; `edit` is what flags change on top."""
    yield from built_envs(profiled)


def at(env: ManagerBasedRlEnv, step: int) -> None:
    """Compute the curriculum at an environment step."""
    env.common_step_counter = step
    env.curriculum_manager.compute()


def weights(env: ManagerBasedRlEnv) -> dict[str, float]:
    manager = env.reward_manager
    return {name: manager.get_term_cfg(name).weight for name in manager.active_terms}


@pytest.mark.parametrize("task", [GO1, G1_TRACKING])
def test_weights_go_from_little_to_those_of_the_task(make_env, task):
    env = make_env(task)
    at(env, 0)
    # Those that the profile adds are constant.
    rewards = {**env.cfg.rewards, **load_env_cfg(task).rewards}
    table = {name: term.weight for name, term in rewards.items()}
    eased = {
        name.removeprefix("eased_")
        for name in env.cfg.curriculum
        if name.removeprefix("eased_") in table
    }
    assert eased
    last = weights(env)
    assert all(last[name] == table[name] for name in table.keys() - eased)
    for step in (500, 3000, 8000, 11_000):
        at(env, step)
        now = weights(env)
        assert all(abs(now[name] - table[name]) <= abs(last[name] - table[name]) for name in eased)
        last = now
    at(env, 10**6)
    assert weights(env) == pytest.approx(table)
    # The config, recorded with the run, is unchanged.
    assert {name: term.weight for name, term in env.cfg.rewards.items()} == table


def test_a_weight_from_a_flag_is_where_its_growth_ends(make_env):
    def edit(cfg) -> None:
        cfg.rewards["action_rate_l2"].weight = -7.0

    env = make_env(GO1, edit=edit)
    at(env, 0)
    assert weights(env)["action_rate_l2"] > -1.0
    at(env, 10**6)
    assert weights(env)["action_rate_l2"] == -7.0


@pytest.mark.parametrize(("step", "part"), [(0, 0.0), (488, 0.5), (10**6, 1.0)])
def test_pushes_grow_to_those_of_the_task(make_env, step, part):
    env = make_env(GO1)
    at(env, step)
    full = load_env_cfg(GO1).events["push_robot"].params["velocity_range"]
    grown = env.event_manager.get_term_cfg("push_robot").params["velocity_range"]
    for axis in full:
        assert grown[axis] == pytest.approx([part * bound for bound in full[axis]], abs=1e-3)
    assert env.cfg.events["push_robot"].params["velocity_range"] == full


def test_pushes_from_a_flag_are_where_their_growth_ends(make_env):
    def edit(cfg) -> None:
        cfg.events["push_robot"].params["velocity_range"] = {"x": (-3.0, 3.0)}

    env = make_env(GO1, edit=edit)
    at(env, 10**6)
    params = env.event_manager.get_term_cfg("push_robot").params
    assert params["velocity_range"] == {"x": (-3.0, 3.0)}


def test_what_is_switched_off_needs_no_further_flag(make_env):
    def edit(cfg) -> None:
        cfg.events["push_robot"] = None
        cfg.rewards["action_rate_l2"] = None

    env = make_env(GO1, edit=edit)
    at(env, 10**6)
    assert "action_rate_l2" not in weights(env)


@pytest.mark.parametrize(("step", "part"), [(0, 0.0), (3906, 0.5), (10**6, 1.0)])
def test_starts_are_perturbed_more_and_more(make_env, step, part):
    def joints_shifted(cfg) -> None:
        # By the same everywhere, so that it shows how much of it there is.
        cfg.commands["motion"].joint_position_range = (0.1, 0.1)

    env = make_env(G1_TRACKING, edit=joints_shifted)
    at(env, step)
    command = env.command_manager.get_term("motion")
    env.command_manager.reset(None)
    apart = command.robot_joint_pos - command.joint_pos
    limits = command.robot.data.soft_joint_pos_limits
    free = (command.joint_pos > limits[..., 0]) & (command.joint_pos + 0.1 < limits[..., 1])
    assert free.float().mean() > 0.8
    assert apart[free] == pytest.approx(0.1 * part, abs=1e-4)
    assert env.cfg.commands["motion"].joint_position_range == (0.1, 0.1)


@pytest.mark.parametrize("num_steps", [1, 2, 3])
def test_coarse_physics_keeps_the_time_of_a_step(num_steps):
    cfg = load_env_cfg(GO1)
    step_dt = cfg.sim.mujoco.timestep * cfg.decimation
    coarsen_physics(cfg, num_steps)
    assert cfg.decimation == num_steps
    assert cfg.sim.mujoco.timestep * num_steps == pytest.approx(step_dt)


@pytest.mark.parametrize("num_steps", [0, 4, 5])
def test_coarse_physics_has_fewer_steps(num_steps):
    with pytest.raises(ValueError, match=f"num_steps: expected 1 to 3 .* got {num_steps}"):
        coarsen_physics(load_env_cfg(GO1), num_steps)


# Difficulty.


@pytest.fixture
def make_growing():
    """Build two environments whose difficulty grows; arguments are those of `GrowingDifficulty`."""

    def cfg(**params):
        cfg = load_env_cfg(GO1)
        cfg.scene.num_envs, cfg.seed, cfg.sim.engine = 2, 1, "native"
        cfg.curriculum = {}
        params = {"reward_name": "track_linear_velocity", "tracking": 0.5, **params}
        grow_difficulty(cfg, **{"survival_s": 1.0, "step": 0.25, "interval": 100, **params})
        return cfg

    for make in built_envs(cfg):

        def reset(*args, make=make, **kwargs):
            env = make(*args, **kwargs)
            env.reset()
            return env

        yield reset


def end_episodes(env: ManagerBasedRlEnv, steps: int, falls: bool, tracking: float) -> float:
    """End an episode in each environment after so many steps; return the difficulty."""
    env.common_step_counter += steps
    env.termination_manager.terminated.fill_(falls)
    weight = env.reward_manager.get_term_cfg("track_linear_velocity").weight
    sums = env.reward_manager.episode_sum("track_linear_velocity")
    sums.fill_(tracking * weight * steps * env.step_dt)
    env.reset()
    return difficulty(env).difficulty


def difficulty(env: ManagerBasedRlEnv) -> GrowingDifficulty:
    return env.curriculum_manager.get_term_cfg("difficulty").func


@pytest.mark.parametrize(
    ("steps", "falls", "tracking", "expected"),
    [
        (120, False, 0.9, 0.25),
        # An episode that falls late enough has survived.
        (120, True, 0.9, 0.25),
        (40, True, 0.9, 0.0),
        (120, False, 0.4, 0.0),
        (40, True, 0.4, 0.0),
        # Truncated before `survival_s`: counts neither as survived nor as fallen.
        (40, False, 0.9, 0.0),
    ],
)
def test_difficulty_grows_only_with_survival_and_tracking(
    make_growing, steps, falls, tracking, expected
):
    env = make_growing()
    grown = 0.0
    for _ in range(math.ceil(100 / steps)):
        grown = end_episodes(env, steps, falls, tracking)
    assert grown == expected


def test_difficulty_grows_once_in_an_interval_and_up_to_one(make_growing):
    env = make_growing()
    assert [end_episodes(env, 60, False, 0.9) for _ in range(4)] == [0.0, 0.25, 0.25, 0.5]
    for _ in range(10):
        end_episodes(env, 100, False, 0.9)
    assert difficulty(env).difficulty == 1.0


def test_a_random_start_within_an_episode_is_no_survival(make_growing):
    env = make_growing()
    env.episode_length_buf[:] = env.max_episode_length - 1
    env.step(torch.zeros(2, env.action_manager.total_action_dim))
    assert env.episode_length_buf.tolist() == [0, 0]
    assert difficulty(env)._tally.tolist()[:2] == [0.0, 0.0]
    assert difficulty(env)._tally.tolist()[3] == 2.0


def in_use(env: ManagerBasedRlEnv) -> tuple:
    ranges = env.command_manager.get_term_cfg("twist").ranges
    pushes = env.event_manager.get_term_cfg("push_robot").params["velocity_range"]
    noise = env.observation_manager.get_term_cfg("actor", "joint_vel").noise
    return ranges.lin_vel_x[1], ranges.ang_vel_z[0], pushes["x"][0], noise.n_max


def test_difficulty_drives_commands_pushes_and_noise(make_growing):
    env = make_growing(command_from=0.5, push_from=0.0, noise_from=0.2)
    last = (1.0, -0.5, -0.5, 1.5)
    assert in_use(env) == pytest.approx((0.5, -0.25, 0.0, 0.3))
    for _ in range(2):
        end_episodes(env, 100, False, 0.9)
    assert in_use(env) == pytest.approx((0.75, -0.375, -0.25, 0.9))
    twist = env.command_manager.get_term("twist").command
    assert twist[:, :2].abs().max() <= 0.75
    for _ in range(2):
        end_episodes(env, 100, False, 0.9)
    assert in_use(env) == last
    # The config, recorded with the run, is unchanged.
    cfg = env.cfg
    assert cfg.commands["twist"].ranges.lin_vel_x == (-1.0, 1.0)
    assert cfg.events["push_robot"].params["velocity_range"]["x"] == (-0.5, 0.5)
    assert cfg.observations["actor"].terms["joint_vel"].noise.n_max == 1.5


def test_ranges_of_another_curriculum_are_grown_to(make_growing):
    env = make_growing()
    end_episodes(env, 100, False, 0.9)
    env.command_manager.get_term_cfg("twist").ranges.lin_vel_x = (-1.5, 2.0)
    for _ in range(2):
        end_episodes(env, 10, False, 0.9)
    assert in_use(env)[:2] == pytest.approx((2.0 * 0.625, -0.5 * 0.625))


def test_difficulty_resumes_exactly(make_growing):
    env, other = make_growing(), make_growing()
    end_episodes(env, 100, False, 0.9)
    end_episodes(env, 60, False, 0.9)
    other.load_state_dict(env.state_dict())
    assert in_use(other) == in_use(env)
    for one in (env, other):
        assert end_episodes(one, 60, False, 0.9) == 0.5
    assert in_use(other) == in_use(env)


def test_evaluations_in_between_do_not_count(make_growing):
    env = make_growing(interval=10)
    before = difficulty(env)._tally.clone()
    with env.curricula_held():
        env.termination_manager.terminated.fill_(True)
        env.step(torch.zeros(2, env.action_manager.total_action_dim))
        env.reset()
    assert torch.equal(difficulty(env)._tally, before)


def test_tracking_needs_a_reward_of_positive_weight(make_growing):
    with pytest.raises(ValueError, match="dof_pos_limits"):
        make_growing(reward_name="dof_pos_limits")
