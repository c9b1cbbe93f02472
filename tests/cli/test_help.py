"""Help: one screen, topics, and what is on them."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from mjlab.cli.flags import parse_flags, with_task_options
from mjlab.cli.help import print_help, requested_topic, screen_rows
from mjlab.cli.train_config import TrainConfig
from mjlab.scripts.evaluate import EvaluateConfig
from mjlab.scripts.play import PlayConfig
from mjlab.scripts.profile_env import ProfileConfig
from mjlab.scripts.share import ShareConfig
from mjlab.tasks.registry import list_tasks, load_env_cfg

TASK = "Mjlab-Cartpole-Swingup"
TRACKING = "Mjlab-Tracking-Flat-Unitree-G1"
TASKS = [name for name in list_tasks() if name.startswith("Mjlab-")]
POLICY_FLAGS = {
    "play": PlayConfig, "demo": PlayConfig, "evaluate": EvaluateConfig, "profile-env": ProfileConfig,
    "share": ShareConfig,
}  # fmt: skip


def flags_in(text: str) -> set[str]:
    """Return the flags a help text lists, those within sentences excepted."""
    return set(re.findall(r"^[│| ] (--[a-z][\w.*-]*[\w*])(?=\s)", text, flags=re.MULTILINE))


def config(command: str, task: str):
    if command in POLICY_FLAGS:
        env = load_env_cfg(task, play=command == "play")
        return with_task_options(POLICY_FLAGS[command](env=env), task)
    return with_task_options(TrainConfig.from_task(task), task)


@pytest.mark.parametrize("task", TASKS)
def test_the_screen_fits_a_terminal(task, capsys):
    for command in ("train", *POLICY_FLAGS):
        print_help(config(command, task), "", f"mjlab {command} {task}")
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) <= 42
        assert max(map(len, lines[1:])) <= 80


@pytest.mark.parametrize("command", ["train", *POLICY_FLAGS])
def test_the_parser_accepts_each_flag_of_the_screen(command):
    default = config(command, TASK)
    rows = screen_rows(default)
    flags = [word for row in rows for word in (row.flag, str(row.default).replace(" ", ""))]
    cfg = parse_flags(type(default), default, flags, command)
    assert screen_rows(cfg) == rows


@pytest.mark.parametrize(
    ("learner", "flag"),
    [("ppo", "entropy-coef"), ("sac", "num-updates"), ("distillation", "learning-rate")],
)
def test_the_screen_has_the_flags_of_the_learner(learner, flag):
    rows = screen_rows(TrainConfig.from_task(TASK, learner=learner))
    assert f"--agent.algorithm.{flag}" in {row.flag for row in rows}
    assert ("--learner", learner) in [(row.flag, row.default) for row in rows]


def test_defaults_on_the_screen_are_those_of_the_task_and_profile(run):
    for profile in ([], ["--profile", "cpu"]):
        cfg = TrainConfig.from_task("Mjlab-Velocity-Flat-Unitree-Go1", *profile[1:])
        out = run("train", "Mjlab-Velocity-Flat-Unitree-Go1", *profile, "--help").out
        for flag, value in (
            ("num-envs", cfg.env.scene.num_envs),
            ("agent.max-iterations", cfg.agent.max_iterations),
            ("agent.algorithm.entropy-coef", cfg.agent.algorithm.entropy_coef),
        ):
            assert re.search(rf"--{flag} .*\[{value}\]", out)
    assert " at 0x" not in out


@pytest.fixture(scope="module")
def everything(run) -> set[str]:
    """Return all flags of `train`."""
    return flags_in(run("train", TASK, "--help", "all").out)


@pytest.mark.parametrize(
    ("topic", "prefix"),
    [("agent", "--agent."), ("rewards", "--env.rewards."), ("env.sim", "--env.sim."),
     ("events.reset-slider", "--env.events.reset-slider."),
     ("agent.algorithm", "--agent.algorithm.")],
)  # fmt: skip
def test_a_topic_lists_the_flags_below_it_by_their_full_names(run, everything, topic, prefix):
    flags = flags_in(run("train", TASK, "--help", topic).out)
    assert flags == {flag for flag in everything if flag.startswith(prefix)} != set()


def test_nothing_that_cannot_be_set_is_listed(run):
    out = run("play", "Mjlab-Velocity-Flat-Unitree-Go1", "--help", "all").out
    assert len(flags_in(out)) > 500
    assert not re.search(r"\{fixed\}|<function|<class| at 0x|\.func ", out)


@pytest.mark.parametrize(
    ("command", "topic", "flag"),
    [("train", "learning-rate", "--agent.algorithm.learning-rate"),
     ("train", "env.episode_length_s", "--env.episode-length-s"),
     ("train", "device", "--device"), ("play", "motion-file", "--motion-file")],
)  # fmt: skip
def test_a_flag_is_a_topic(run, command, topic, flag):
    out = run(command, TRACKING, "--help", topic).out
    assert flags_in(out) == {flag}
    assert len(out.splitlines()) < 20


@pytest.mark.parametrize("command", ["train", "play"])
def test_the_command_is_the_topic_of_its_own_flags(run, command):
    flags = flags_in(run(command, TRACKING, "--help", command).out)
    assert {"--device", "--video-length", "--motion-file"} <= flags
    assert not [flag for flag in flags if "." in flag]


@pytest.mark.parametrize(
    ("topic", "named"), [("rewrds", "rewards"), ("lerning-rate", "learning-rate")]
)
def test_an_unknown_topic_is_answered_with_the_nearest(run, topic, named):
    outcome = run("evaluate" if topic == "rewrds" else "train", TASK, "--help", topic)
    assert outcome.status == 2
    assert f"unknown topic '{topic}'; did you mean '{named}'" in outcome.message


def test_a_name_of_several_flags_is_answered_with_them(run):
    outcome = run("train", TASK, "--help", "hidden-dims")
    assert outcome.status == 2
    assert "agent.actor.hidden-dims" in outcome.message
    assert "agent.critic.hidden-dims" in outcome.message


@pytest.mark.parametrize(
    ("flags", "topic"),
    [([], None), (["--video"], None), (["-h"], ""), (["--help", "--video"], "video"),
     (["--profile", "cpu", "--help", "agent"], "agent"), (["--help=env.sim"], "env.sim"),
     (["--help", "--env.seed"], "env.seed"), (["--help", "--profile", "cpu"], "")],
)  # fmt: skip
def test_the_topic_follows_the_flag(flags, topic):
    assert requested_topic(flags) == topic


@pytest.mark.slow
def test_the_screen_does_not_load_the_learner():
    code = (
        f"import sys; sys.argv = ['train', {TASK!r}, '--help']\n"
        "from mjlab.cli.main import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "assert not {'rsl_rl', 'wandb', 'tensordict'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
