"""`--profile`: named settings of a task, from the command line to the run folder and back."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from commands import TASK

from mjlab.cli.flags import suggest_profile
from mjlab.cli.policy_flags import env_cfg_of, parse_policy_flags
from mjlab.cli.train_config import parse_train_flags
from mjlab.runs import Run
from mjlab.runs.folder import write_info
from mjlab.runs.run import registered_env_cfg
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.train import TrainConfig
from mjlab.tasks import registry
from mjlab.tasks.cpu_profile import cpu_profile

PROFILED = "Test-Profiled"
PLAIN = "Test-Plain"
"""A task without profiles."""


def cpu(env_cfg, rl_cfg) -> None:
    env_cfg.scene.num_envs = 6
    env_cfg.decimation = 3
    # An observation less, so that the networks have other inputs than the task's own.
    del env_cfg.observations["actor"].terms["pole_vel"]
    rl_cfg.actor.hidden_dims = (8,)
    rl_cfg.actor.activation = "tanh"
    rl_cfg.num_steps_per_env = 4
    rl_cfg.max_iterations = 1


@pytest.fixture(autouse=True)
def _profiled_task(monkeypatch):
    registry.list_tasks()
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    registry.register_mjlab_task(
        PROFILED,
        registry._tasks[TASK].env_cfg,
        rl_cfg=registry._tasks[TASK].rl_cfg,
        profiles={"cpu": cpu, "big": lambda env_cfg, rl_cfg: None},
    )
    own = registry._tasks[TASK]
    registry.register_mjlab_task(PLAIN, own.env_cfg, rl_cfg=own.rl_cfg)


@pytest.fixture
def profiled(run, tmp_path) -> Path:
    """Return the folder of a run of one iteration under the profile."""
    outcome = train(run, tmp_path, "--profile", "cpu")
    assert outcome.status == 0, outcome.err
    assert f"{PROFILED}, 6 environments, profile cpu" in outcome.out
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    return run_dir


def train(run, log_root: Path, *flags: str):
    return run("train", PROFILED, "--device", "cpu", "--log-root", str(log_root), *flags)


def params(run_dir: Path, name: str) -> dict:
    return yaml.safe_load((run_dir / "params" / f"{name}.yaml").read_text())


def test_a_profile_sets_what_flags_start_from_and_flags_win():
    flags = ["--agent.num-steps-per-env", "9", "--profile=cpu", "--env.scene.num-envs", "5"]
    cfg = parse_train_flags(PROFILED, flags, "train")
    assert cfg.profile == "cpu"
    assert cfg.agent.actor.hidden_dims == (8,)  # ty: ignore
    assert (cfg.env.decimation, cfg.env.scene.num_envs, cfg.agent.num_steps_per_env) == (3, 5, 9)
    for flags in ([], ["--profile", "None"]):
        cfg = parse_train_flags(PROFILED, flags, "train")
        assert cfg.agent == TrainConfig.from_task(TASK).agent
        assert (cfg.env.decimation, cfg.profile) == (5, None)


def test_the_run_says_its_profile_and_holds_its_settings(profiled):
    assert Run(profiled).info["profile"] == "cpu"
    assert params(profiled, "agent")["actor"]["hidden_dims"] == [8]
    assert params(profiled, "env")["decimation"] == 3


def shorten_episodes(env_cfg, rl_cfg) -> None:
    env_cfg.episode_length_s = 0.1


def ease(env_cfg, rl_cfg) -> None:
    env_cfg.episode_length_s = 5.0


def test_only_training_is_eased():
    registry.register_mjlab_task(
        "Test-Easier",
        registry._tasks[TASK].env_cfg,
        rl_cfg=registry._tasks[TASK].rl_cfg,
        profiles={"cpu": registry.Profile(shorten_episodes, ease)},
    )
    assert (
        parse_train_flags("Test-Easier", ["--profile", "cpu"], "train").env.episode_length_s == 5.0
    )
    assert registered_env_cfg("Test-Easier", "cpu", "evaluate").episode_length_s == 0.1
    assert registered_env_cfg("Test-Easier", "cpu", "play").episode_length_s == 0.1
    assert registered_env_cfg("Test-Easier", "cpu", "train").episode_length_s == 5.0
    flags = ["--profile", "cpu", "--env.episode-length-s", "0.3"]
    cfg = parse_policy_flags(EvaluateConfig, flags, "Test-Easier", "evaluate", purpose="evaluate")
    assert env_cfg_of("Test-Easier", cfg, None, purpose="evaluate").episode_length_s == 0.3


@pytest.mark.parametrize("script", ["train", "play", "evaluate", "train_seeds"])
def test_a_profile_that_does_not_exist_is_told_with_those_that_do(run, tmp_path, script):
    outcome = run(script, PROFILED, "--profile", "gpu", "--log-root", str(tmp_path))
    assert outcome.status == 1
    assert "'gpu'" in outcome.message
    assert "['big', 'cpu']" in outcome.message
    outcome = run(script, PLAIN, "--profile", "cpu", "--log-root", str(tmp_path))
    assert "available: []" in outcome.message
    assert not list(tmp_path.iterdir())


def test_resuming_keeps_the_profile(run, profiled):
    root = profiled.parents[1]
    outcome = train(run, root, "--agent.resume", "True", "--agent.max-iterations", "2")
    assert outcome.status == 0, outcome.err
    assert "Resuming with the profile 'cpu'" in outcome.err
    assert "random numbers restart" not in outcome.err
    (resumed,) = set(profiled.parent.iterdir()) - {profiled}
    assert Run(resumed).info["profile"] == "cpu"
    assert params(resumed, "env")["decimation"] == 3
    assert params(resumed, "env")["scene"]["num_envs"] == 6
    # Without the profile the networks differ, and loading the checkpoint raises.
    outcome = train(run, root, "--agent.resume", "True", "--profile", "None")
    assert outcome.status == 1
    assert "actor" in outcome.message


@pytest.mark.parametrize(
    ("variables", "tells"),
    [
        ({}, True),
        ({"RANK": "1", "WORLD_SIZE": "2"}, False),
    ],
)
def test_one_process_tells_the_resumed_profile(profiled, monkeypatch, capsys, variables, tells):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    flags = ["--agent.resume", "True", "--log-root", str(profiled.parents[1])]
    assert parse_train_flags(PROFILED, flags, "train").profile == "cpu"
    output = capsys.readouterr()
    assert ("Resuming with the profile" in output.err + output.out) == tells


def test_play_and_evaluate_find_the_profile_of_the_run(run, profiled):
    common = ("--log-root", str(profiled.parents[1]), "--device", "cpu")
    named = ("--checkpoint-file", str(profiled / "model_0.pt"))
    outcome = run("play", PROFILED, "--viewer", "none", "--num-steps", "2", *common, *named)
    assert outcome.status == 0, outcome.err
    # The number of environments to learn with is not that to look at.
    assert "2 steps in 1 environment," in outcome.out
    outcome = run(
        "evaluate", PROFILED, "--num-episodes", "2", "--max-steps", "3", "--json", *common
    )
    assert outcome.status == 0, outcome.err
    assert json.loads(outcome.out)["num_episodes"] == 2


def test_play_without_the_profile_refuses_the_policy(run, profiled):
    flags = ("--log-root", str(profiled.parents[1]), "--device", "cpu", "--profile", "None")
    outcome = run("play", PROFILED, "--viewer", "none", "--num-steps", "2", *flags)
    assert outcome.status == 1
    assert profiled.name in outcome.message


def test_a_profile_that_the_task_no_longer_has_is_told(run, profiled):
    write_info(profiled, profile="gone")
    flags = ("--log-root", str(profiled.parents[1]), "--device", "cpu")
    outcome = run("play", PROFILED, "--viewer", "none", "--num-steps", "2", *flags)
    assert outcome.status == 1
    assert "profile: 'gone' of the run left out: unknown to Test-Profiled" in outcome.err


def test_on_a_cpu_the_profile_is_suggested_in_one_line(run, tmp_path):
    short = ("--agent.max-iterations", "1", "--agent.num-steps-per-env", "2", "--num-envs", "2")
    suggested = f"`uv run mjlab train {PROFILED} --profile cpu`"
    outcome = train(run, tmp_path, *short)
    assert [suggested in line for line in outcome.err.splitlines()].count(True) == 1
    resumed = train(run, tmp_path, *short, "--agent.resume", "True", "--agent.max-iterations", "2")
    assert resumed.status == 0, resumed.err
    assert suggested not in resumed.err


@pytest.mark.parametrize(
    ("task", "profile", "device", "lines"),
    [
        (PROFILED, None, "cpu", 1),
        (PROFILED, "cpu", "cpu", 0),
        (PROFILED, "big", "cpu", 0),
        (PROFILED, None, "cuda:0", 0),
        (PLAIN, None, "cpu", 0),
    ],
)
def test_a_profile_is_suggested_only_where_it_is_of_use(task, profile, device, lines, capsys):
    suggest_profile(task, profile, device)
    assert len(capsys.readouterr().err.splitlines()) == lines


def test_train_seeds_hands_the_profile_on(run, monkeypatch):
    seen = []
    name = "mjlab.scripts.train_seeds.run_forwarding_signals"
    monkeypatch.setattr(name, lambda command: (seen.append(command), (0, False))[1])
    assert run("train_seeds", PROFILED, "--profile", "cpu", "--seeds", "1").status == 0
    assert seen[0][seen[0].index("--profile") + 1] == "cpu"


def test_list_envs_shows_profiles_and_imports_no_torch(run):
    lines = run("list_envs").out.splitlines()
    (line,) = (line for line in lines if PROFILED in line)
    assert line.endswith("(profiles: big, cpu)")
    (line,) = (line for line in lines if PLAIN in line)
    assert line.endswith(PLAIN)
    code = (
        "import sys\nfrom mjlab.scripts.list_envs import command\ncommand([], 'list-envs')\n"
        "assert not {'torch', 'mujoco'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_help_tells_of_it(run):
    outcome = run("train", PROFILED, "--profile", "cpu", "--help")
    assert "--profile" in outcome.out
    assert EvaluateConfig().profile is None


OWN = "Own-Robot"
GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"


@pytest.fixture
def own_task(monkeypatch):
    """Register a custom task with a `cpu` profile."""
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))
    registry.register_mjlab_task(
        task_id=OWN,
        env_cfg=registry.load_env_cfg(GO1),
        play_env_cfg=registry.load_env_cfg(GO1, play=True),
        rl_cfg=registry.load_rl_cfg(GO1),
        profiles={
            "cpu": cpu_profile(
                physics_steps=2,
                simple_contacts=True,
                hidden_dims=(16,),
                mirror="mjlab.tasks.velocity.symmetry:mirror_left_right",
            )
        },
    )


@pytest.mark.slow
def test_a_custom_task_has_custom_profiles(own_task, run, tmp_path):
    short = ("--env.episode-length-s", "0.1", "--device", "cpu")
    trained = run(
        "train", OWN, "--profile", "cpu", "--log-root", str(tmp_path), "--num-envs", "4",
        "--agent.num-steps-per-env", "4", "--agent.max-iterations", "2",
        "--agent.evaluation.solved-return", "1e9", "--agent.evaluation.trigger-return", "-1e9",
        "--agent.evaluation.min-interval", "2", "--agent.evaluation.num-episodes", "2", *short,
    )  # fmt: skip
    assert trained.status == 0, trained.err
    assert "Finished: unsolved at iteration 2 of 2" in trained.out
    assert "missed by" in trained.out
    (params,) = tmp_path.glob("*/*/params/env.yaml")
    assert "decimation: 2" in params.read_text()
    (checkpoint,) = tmp_path.glob("*/*/model_1.pt")
    score = run(
        "evaluate", OWN, "--checkpoint-file", str(checkpoint), "--num-episodes", "2", *short
    )
    assert score.status == 0, score.err
