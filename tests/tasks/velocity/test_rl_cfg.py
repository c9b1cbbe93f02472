"""The `cpu` profiles make velocity tasks easier to learn, and not easier to pass."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl.config import RslRlOffPolicyRunnerCfg
from mjlab.rl.evaluation import wilson_interval
from mjlab.tasks.registry import list_profiles, list_tasks, load_env_cfg, load_rl_cfg
from mjlab.tasks.velocity.rl import ppo

TASKS = [task for task in list_tasks() if task.startswith("Mjlab-Velocity")]


@pytest.mark.parametrize("task", TASKS)
def test_contacts_are_simple_in_training(task):
    env_cfg = load_env_cfg(task, profile="cpu")
    assert env_cfg.sim.mujoco.cone == "pyramidal"
    for collision in env_cfg.scene.entities["robot"].collisions:
        dims = (
            collision.condim.values() if isinstance(collision.condim, dict) else [collision.condim]
        )
        assert max(dims) <= 3


@pytest.mark.parametrize("task", [task for task in TASKS if "Go1" in task])
@pytest.mark.parametrize("gait", [((0, 3), (1, 2)), None])
def test_penalties_are_eased_and_nothing_else(task, gait):
    """A gait and the yaw rate are rewarded; where the gait is unknown, a reward for air time fades out."""
    table, rl_cfg = load_env_cfg(task), load_rl_cfg(task)
    env_cfg = load_env_cfg(task)
    profile = (
        ppo.cpu_without_gait() if gait is None else ppo.cpu_with_gait(gait, minimum_height=0.1)
    )
    profile.easing(env_cfg, rl_cfg)
    added = set() if gait is None else {"gait", "yaw"}
    assert env_cfg.rewards.keys() - table.rewards.keys() == added
    eased = {name for name, term in table.rewards.items() if term.weight < 0}
    if gait is None:
        eased.add("air_time")
    for name, term in table.rewards.items():
        easing = env_cfg.curriculum.get(f"eased_{name}")
        assert (easing is not None) == (name in eased)
        if name in eased - {"air_time"}:
            assert easing.params["first"] == pytest.approx(0.02 * term.weight)


@pytest.mark.parametrize("task", [task for task in TASKS if "Go1" in task])
def test_given_bounds_hold_on_all_ground(task):
    bounds = {"lin_vel_error": 0.3, "failure_rate": 0.1}
    env_cfg, rl_cfg = load_env_cfg(task), load_rl_cfg(task)
    profile = ppo.cpu_with_gait(((0, 3), (1, 2)), minimum_height=0.1, solved_below=bounds)
    profile.easing(env_cfg, rl_cfg)
    assert rl_cfg.evaluation.solved_below == bounds


@pytest.mark.parametrize("task", [task for task in TASKS if "Go1" in task])
def test_policies_act_within_bounds_on_rough_ground(task):
    actors = [load_rl_cfg(task, profile="cpu").actor]
    if "blind" in list_profiles(task):
        student = load_rl_cfg(task, profile="blind")
        actors.append(student.teacher)
        assert student.clip_actions == 4.0
    for actor in actors:
        # One unit is a quarter of a motor's torque.
        assert actor.distribution_cfg.get("bound") == (4.0 if "Rough" in task else None)
        assert actor.distribution_cfg["init_std"] == 0.8


@pytest.mark.parametrize("task", [task for task in TASKS if "Go1" in task])
def test_the_gait_of_the_go1_is_a_trot(task):
    cfg = load_env_cfg(task, profile="cpu")
    (sensor,) = [s for s in cfg.scene.sensors if s.name == "feet_ground_contact"]
    feet = [name[:2] for name in sensor.primary.pattern]
    groups = {frozenset(feet[i] for i in g) for g in cfg.rewards["gait"].params["groups"]}
    assert groups == {frozenset({"FR", "RL"}), frozenset({"FL", "RR"})}
    assert sensor.track_air_time


@pytest.mark.parametrize("task", [task for task in TASKS if "cpu-long" in list_profiles(task)])
def test_cpu_long_is_cpu_with_stricter_bounds(task):
    assert load_env_cfg(task, profile="cpu-long") == load_env_cfg(task, profile="cpu")
    long, cpu = (load_rl_cfg(task, profile=profile) for profile in ("cpu-long", "cpu"))
    assert dataclasses.replace(long, evaluation=cpu.evaluation) == cpu
    assert long.evaluation.solved_below.keys() == cpu.evaluation.solved_below.keys()
    for name, limit in long.evaluation.solved_below.items():
        assert limit < cpu.evaluation.solved_below[name]
    assert long.evaluation.num_episodes > cpu.evaluation.num_episodes


@pytest.mark.parametrize("task", TASKS)
def test_episodes_suffice_for_the_bound_on_failures(task):
    """Half as many failures as the bound meet it, judged by the center of an interval."""
    for profile in list_profiles(task):
        cfg = load_rl_cfg(task, profile=profile).evaluation
        limit = cfg.solved_below.get("failure_rate", 1.0)
        rate = int(0.5 * limit * cfg.num_episodes) / cfg.num_episodes
        assert sum(wilson_interval(rate, cfg.num_episodes)) / 2 <= limit


@pytest.mark.parametrize("task", TASKS)
def test_exploring_errors_trigger_before_the_bound(task):
    """Exploration adds to errors, so a policy that meets a bound is evaluated."""
    for profile in list_profiles(task):
        cfg = load_rl_cfg(task, profile=profile).evaluation
        for name, limit in cfg.trigger_below.items():
            assert cfg.solved_below[name] < limit


@pytest.mark.parametrize("task", [task for task in TASKS if "Rough" in task])
def test_levels_are_all_used_and_kept_until_robots_walk(task):
    for profile in list_profiles(task):
        cfg = load_env_cfg(task, profile=profile)
        params = cfg.curriculum["terrain_levels"].params
        assert cfg.scene.terrain.max_init_terrain_level is None
        assert params["use_elapsed_time"]
        assert params["first_step"] * cfg.scene.num_envs >= 390_000
        registered = load_env_cfg(task, profile=profile, evaluate=True)
        assert registered.scene.terrain == load_env_cfg(task).scene.terrain


def test_a_student_is_judged_as_its_teacher():
    task = "Mjlab-Velocity-Rough-Unitree-Go1"
    teacher, student = (
        load_rl_cfg(task, profile=profile).evaluation for profile in ("cpu", "blind")
    )
    assert student == teacher


@pytest.mark.parametrize("terrain", ["Flat", "Rough"])
def test_the_humanoid_keeps_its_penalties(terrain):
    task = f"Mjlab-Velocity-{terrain}-Unitree-G1"
    env_cfg, table = load_env_cfg(task, profile="cpu"), load_env_cfg(task)
    for name, term in table.rewards.items():
        if term.weight < 0.0:
            assert env_cfg.rewards[name].weight <= term.weight
    assert isinstance(load_rl_cfg(task, profile="cpu"), RslRlOffPolicyRunnerCfg)
    env_cfg.scene.num_envs = 4
    env_cfg.curriculum["difficulty"].params |= {"interval": 1, "survival": -1.0, "tracking": -1.0}
    env = ManagerBasedRlEnv(env_cfg, device="cpu")
    try:
        env.reset()
        twist = env.command_manager.get_term("twist")
        ranges = [twist.cfg.ranges.lin_vel_x]
        for _ in range(21):
            env.step(torch.zeros(4, env.action_manager.total_action_dim))
            env.reset()
            ranges.append(twist.cfg.ranges.lin_vel_x)
        assert ranges == sorted(ranges, key=lambda bounds: bounds[1])
        assert ranges[-1] == pytest.approx(table.commands["twist"].ranges.lin_vel_x)
    finally:
        env.close()


def test_errors_of_standing_still(go1):
    robot = go1.scene["robot"]
    robot.write_root_link_velocity_to_sim(torch.zeros(4, 6))
    go1.sim.forward()
    torch.testing.assert_close(ppo.standing_lin_vel_error(go1), ppo.lin_vel_error(go1))
    term = go1.command_manager.get_term("twist")
    term.is_heading_env[:] = torch.tensor([True, True, False, False])
    term.is_standing_env[:] = torch.tensor([False, True, False, True])
    error = ppo.standing_ang_vel_error(go1)
    torch.testing.assert_close(error[2:], ppo.ang_vel_error(go1)[2:])
    torch.testing.assert_close(error[1], ppo.ang_vel_error(go1)[1])
    # k a up to 0.5 rad/s, which errors of 1 to pi rad exceed: (0.25 + 0.5 (pi - 1)) / pi.
    assert error[0] == pytest.approx((0.25 + 0.5 * (math.pi - 1.0)) / math.pi, rel=1e-3)
