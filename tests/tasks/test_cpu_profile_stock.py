"""Evaluations, `evaluate` and `play` undo the simplifications of `cpu` profiles."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from mjlab.tasks.registry import list_profiles, list_tasks, load_env_cfg, load_rl_cfg
from mjlab.utils.os import dump_yaml

TASKS = [task for task in list_tasks() if "cpu" in list_profiles(task)]

CLOCKED = [f"Mjlab-Velocity-{terrain}-Unitree-G1" for terrain in ("Flat", "Rough")]


def written(cfg, path):
    dump_yaml(path, asdict(cfg))
    return path.read_text()


def test_there_are_tasks_with_such_a_profile():
    assert len(TASKS) >= 10


@pytest.mark.parametrize("play", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_evaluations_are_those_of_the_task_without_the_profile(task, play, tmp_path):
    plain, eased = load_env_cfg(task, play=play), load_env_cfg(task, play=play, profile="cpu")
    for cfg, profile in ((plain, None), (eased, "cpu")):
        prepare = load_rl_cfg(task, profile=profile).evaluation.prepare_env
        if prepare is not None:
            prepare(cfg)
    # The number of environments does not affect the difficulty.
    eased.scene.num_envs = plain.scene.num_envs
    if task in CLOCKED:
        # Action and observation spaces of the policy stay; models, pushes and terminations are the task's.
        assert type(eased.actions["joint_pos"]) is type(plain.actions["joint_pos"])
        eased.actions = plain.actions
        del eased.commands["gait"], eased.observations["teacher"]
        for name in ("base_lin_vel", "base_ang_vel", "projected_gravity"):
            eased.observations["actor"].terms[name].history_length = 0
        for group in eased.observations.values():
            del group.terms["gait"]
    assert written(eased, tmp_path / "eased.yaml") == written(plain, tmp_path / "plain.yaml")


def test_evaluations_keep_what_a_flag_has_changed_since():
    cfg = load_env_cfg(CLOCKED[0], profile="cpu")
    cfg.rewards["foot_slip"].weight = -3.0
    cfg.rewards["action_rate_l2"].weight = -4.0
    cfg.rewards["foot_clearance"] = None
    cfg.terminations["fell_over"].params["limit_angle"] = 0.5
    cfg.scene.entities["robot"].collisions = ()
    load_rl_cfg(CLOCKED[0], profile="cpu").evaluation.prepare_env(cfg)
    assert cfg.rewards["foot_slip"].weight == -3.0
    assert cfg.rewards["action_rate_l2"].weight == -4.0
    assert cfg.rewards["foot_clearance"] is None
    assert cfg.rewards["dof_pos_limits"].weight == -1.0
    assert "alive" not in cfg.rewards
    assert cfg.terminations["fell_over"].params["limit_angle"] == 0.5
    assert cfg.scene.entities["robot"].collisions == ()
