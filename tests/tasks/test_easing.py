"""What `cpu` profiles ease grows to what the task, and whoever gave a flag, says, and is dropped whole."""

from __future__ import annotations

import copy

import pytest
from built_envs import built_envs

from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.easing import Easing, coarsen_physics, drop_easing
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
    """Ask the curriculum what holds after so many steps."""
    env.common_step_counter = step
    env.curriculum_manager.compute()


def weights(env: ManagerBasedRlEnv) -> dict[str, float]:
    manager = env.reward_manager
    return {name: manager.get_term_cfg(name).weight for name in manager.active_terms}


@pytest.mark.parametrize("task", [GO1, G1_TRACKING])
def test_weights_go_from_little_to_those_of_the_task(make_env, task):
    env = make_env(task)
    at(env, 0)
    table = {name: term.weight for name, term in load_env_cfg(task).rewards.items()}
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
    # Nothing of this is in the config, which is recorded with a run.
    assert {name: term.weight for name, term in env.cfg.rewards.items()} == table


def test_a_weight_from_a_flag_is_where_its_growth_ends(make_env):
    def edit(cfg) -> None:
        cfg.rewards["action_rate_l2"].weight = -7.0

    env = make_env(GO1, edit=edit)
    at(env, 0)
    assert weights(env)["action_rate_l2"] > -1.0
    at(env, 10**6)
    assert weights(env)["action_rate_l2"] == -7.0


@pytest.mark.parametrize(("step", "part"), [(0, 0.0), (1953, 0.5), (10**6, 1.0)])
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


def test_dropping_leaves_the_curriculum_of_the_task():
    cfg = load_env_cfg(GO1, profile="cpu")
    kept = load_env_cfg(GO1).curriculum
    assert any(issubclass(term.func, Easing) for term in cfg.curriculum.values() if term
               and isinstance(term.func, type))  # fmt: skip
    cfg.curriculum["nothing"] = None
    drop_easing(cfg)
    assert set(cfg.curriculum) == {*kept, "nothing"}


def test_coarse_physics_keeps_the_time_of_a_step_and_leaves_flags_alone():
    cfg = load_env_cfg(GO1)
    fine = (cfg.sim.mujoco.timestep, cfg.decimation)
    undo = coarsen_physics(cfg)
    assert (cfg.sim.mujoco.timestep, cfg.decimation) == (2 * fine[0], fine[1] // 2)
    changed = copy.deepcopy(cfg)
    changed.sim.mujoco.timestep, changed.decimation = 0.002, 10
    for one, expected in ((cfg, fine), (changed, (0.002, 10))):
        undo(one)
        assert (one.sim.mujoco.timestep, one.decimation) == expected


def test_an_odd_number_of_physics_steps_has_no_half():
    cfg = load_env_cfg(GO1)
    cfg.decimation = 5
    with pytest.raises(ValueError, match="half of 5 steps"):
        coarsen_physics(cfg)
