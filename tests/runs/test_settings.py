"""Settings: recorded, read and applied again with the values of the run."""

from __future__ import annotations

import json

import pytest

from mjlab.cli.flags import parse_flags
from mjlab.rl.config import RslRlDistillationRunnerCfg
from mjlab.runs import Run, newest_run, runs_in
from mjlab.runs.folder import write_info, write_params
from mjlab.runs.settings import apply_settings, differences, typed_settings, with_changes
from mjlab.scripts.train import TrainConfig
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.os import to_plain

GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
G1 = "Mjlab-Velocity-Flat-Unitree-G1"
CARTPOLE = "Mjlab-Cartpole-Balance"
CALF = "std_walking..*(FR|FL|RR|RL)_calf_joint.*"


def changed(cfg) -> dict[str, object]:
    registered = to_plain(load_env_cfg(GO1))
    return {one.path: one.now for one in differences(cfg, registered, "env")}


def test_other_joint_patterns_hold_as_a_whole():
    cfg = load_env_cfg(GO1)
    cfg.actions["joint_pos"].scale = {".*": 0.5}
    cfg.scene.entities["robot"].init_state.joint_pos = {".*calf_joint": -1.5}
    cfg.rewards["pose"].params["std_walking"] = {".*": 0.7}
    cfg.events["push_robot"].params["velocity_range"] = {"x": (-1.0, 1.0)}
    again, left_out = apply_settings(load_env_cfg(GO1), changed(cfg), "env")
    assert left_out == {}
    assert again.actions["joint_pos"].scale == {".*": 0.5}
    assert again.scene.entities["robot"].init_state.joint_pos == {".*calf_joint": -1.5}
    assert again.rewards["pose"].params["std_walking"] == {".*": 0.7}
    assert again.events["push_robot"].params["velocity_range"] == {"x": (-1.0, 1.0)}


@pytest.mark.parametrize("is_bounded", [True, False])
def test_a_bound_of_actions_is_kept_as_trained(is_bounded):
    """Also where the profile has had one since then, or has none any more."""
    free, bounded = (
        load_rl_cfg(task, profile="cpu") for task in (GO1, GO1.replace("Flat", "Rough"))
    )
    trained, registered = (bounded, free) if is_bounded else (free, bounded)
    settings = {
        one.path: one.recorded for one in differences(registered, to_plain(trained), "agent")
    }
    again, left_out = apply_settings(registered, settings, "agent")
    assert left_out == {}
    assert again.actor.distribution_cfg == trained.actor.distribution_cfg


def test_typed_patterns_are_recorded_as_typed():
    flags = ["--env.actions.joint-pos.scale", "{'.*': 0.5}"]
    # A key that begins with a dot, with the registered value.
    flags += ["--env.rewards.pose.params.std-walking.*(FR|FL|RR|RL)-calf-joint.*", "0.6"]
    cfg = parse_flags(TrainConfig, TrainConfig.from_task(GO1), flags, "train")
    assert typed_settings(cfg.env, "env", flags) == {
        "env.actions.joint_pos.scale": {".*": 0.5},
        f"env.rewards.pose.params.{CALF}": 0.6,
    }


def test_settings_of_missing_terms_say_so():
    settings = {
        "env.events.push_robot.interval_range_s": [2.0, 4.0],
        "env.rewards.gone.weight": 2.0,
        "env.rewards.gone.params.std": 2.0,
        "env.rewards.upright.__dict__": {"func": "os:system"},
        # Nothing to switch off.
        "env.curriculum.gone": None,
    }
    cfg, left_out = apply_settings(load_env_cfg(GO1, play=True), settings, "env")
    assert left_out == dict.fromkeys([*settings][:4], "not part of this config")
    assert to_plain(cfg) == to_plain(load_env_cfg(GO1, play=True))


def test_settings_of_the_machine_are_not_applied():
    settings = {"env.scene.num_envs": 100_000, "env.seed": 5}
    cfg, left_out = apply_settings(load_env_cfg(CARTPOLE), settings, "env")
    registered = load_env_cfg(CARTPOLE)
    assert (cfg.scene.num_envs, cfg.seed) == (registered.scene.num_envs, registered.seed)
    assert left_out == {}


def test_teacher_and_bounds_of_metrics_are_kept():
    agent = load_rl_cfg(CARTPOLE, learner="distillation")
    settings = {
        "agent.teacher_checkpoint": "/runs/a/model_9.pt",
        "agent.evaluation.solved_above": {"foot/height m": 0.5},
    }
    cfg, left_out = apply_settings(agent, settings, "agent")
    assert isinstance(cfg, RslRlDistillationRunnerCfg)
    assert left_out == {}
    assert cfg.teacher_checkpoint == "/runs/a/model_9.pt"
    assert cfg.evaluation.solved_above == {"foot/height m": 0.5}


def test_a_profile_that_is_gone_is_one_line(tmp_path, capsys):
    write_info(tmp_path, task=CARTPOLE, profile="gone", settings={})
    run = Run(tmp_path)
    assert run.profile is None
    (note,) = run.notes("play", run.cfg("play"), None)
    assert "profile: 'gone' of the run left out" in note
    assert capsys.readouterr().err == ""


def test_lists_of_other_lengths_are_told_apart(tmp_path):
    cfg = load_env_cfg(GO1)
    cfg.scene.entities["robot"].articulation.actuators += (
        cfg.scene.entities["robot"].articulation.actuators[0],
    )
    write_info(tmp_path, task=GO1, settings={})
    write_params(tmp_path, cfg, load_rl_cfg(GO1))
    (note,) = Run(tmp_path).notes("train", Run(tmp_path).cfg(), None)
    assert "actuators: 2 entries today, 3 entries" in note


def test_each_note_is_a_short_line(tmp_path):
    settings = {"env.rewards.smooth_reward": None, "env.x\x1b[2J\ny": "a\nb"}
    write_info(tmp_path, task=CARTPOLE, settings=settings)
    run = Run(tmp_path)
    notes = run.notes("train", run.cfg(), None)
    assert len(notes) == 2
    assert all(line.isprintable() and len(line) < 200 for line in notes)


@pytest.mark.parametrize(
    "info",
    [
        {"evaluations": 5},
        {"evaluations": [5, {"iteration": "x"}, {"iteration": 1, "mean_return": None}]},
        {"started": "2026-01-01T00:00:00+00:00"},
        {"learner": "unknown"},
    ],
)
def test_odd_metadata_do_not_stop_a_command(tmp_path, info):
    for name, more in (("a", info), ("2026-01-01_00-00-00", {})):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model_1.pt").touch()
        write_info(tmp_path / name, task=CARTPOLE, **more)
    run = Run(tmp_path / "a")
    assert run.describe().endswith("interrupted")
    assert run.cfg().env.decimation == 5
    assert newest_run(runs_in(tmp_path, CARTPOLE)) is not None


def test_odd_parameters_do_not_stop_a_command(tmp_path):
    cfg = load_env_cfg(CARTPOLE)
    write_params(tmp_path, cfg, load_rl_cfg(CARTPOLE))
    for text in ("observations: null", "observations: [1]\nactions: 5", "decimation: 2026-01-01"):
        (tmp_path / "params" / "env.yaml").write_text(text)
        run = Run(tmp_path, CARTPOLE)
        run.check_terms(cfg, ("actor", "critic"))
        json.dumps(run.settings)
    for text in ("obs_groups: {actor: 5}", "obs_groups: {actor: [[1]]}"):
        (tmp_path / "params" / "agent.yaml").write_text(text)
        Run(tmp_path, CARTPOLE).check_terms(cfg, ("actor", "critic"))


def test_changes_reach_what_both_configs_have():
    registered, changed = (load_env_cfg(G1, profile="cpu") for _ in range(2))
    changed.rewards["foot_slip"].weight = -3.0
    changed.rewards["linear"].weight = 7.0
    changed.rewards["mine"] = changed.rewards["alive"]
    del changed.rewards["soft_landing"]
    changed.rewards["foot_clearance"] = None  # ty: ignore
    changed.terminations["fell_over"].params["limit_angle"] = 0.5
    changed.scene.sensors[0].debug_vis = False
    changed.scene.entities["robot"].collisions = ()
    cfg = load_env_cfg(G1, profile="cpu", evaluate=True)
    made = with_changes(cfg, changed, registered)
    assert list(made.rewards) == [*(n for n in cfg.rewards if n != "soft_landing"), "mine"]
    assert made.rewards["foot_slip"].weight == -3.0
    assert made.rewards["foot_clearance"] is None
    assert made.rewards["action_rate_l2"] == cfg.rewards["action_rate_l2"]
    assert made.terminations["fell_over"].params["limit_angle"] == 0.5
    assert not made.scene.sensors[0].debug_vis
    assert made.scene.entities["robot"].collisions == ()
    assert made.decimation == 4
    assert to_plain(cfg) == to_plain(load_env_cfg(G1, profile="cpu", evaluate=True))


@pytest.mark.parametrize("task", [G1, GO1, CARTPOLE])
def test_without_changes_a_config_is_the_same(task):
    registered, cfg = load_env_cfg(task), load_env_cfg(task, play=True)
    assert to_plain(with_changes(cfg, load_env_cfg(task), registered)) == to_plain(cfg)
    assert to_plain(with_changes(registered, cfg, registered)) == to_plain(cfg)
