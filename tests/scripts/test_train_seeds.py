"""`train-seeds`: one task over several seeds."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest
from commands import SMALL, interrupt_training

from mjlab.rl import EvaluationCfg
from mjlab.rl.plot import read_scalars
from mjlab.runs import Run
from mjlab.tasks import registry

TASK = "Mjlab-Cartpole-Swingup"


@pytest.fixture
def commands(monkeypatch) -> list[list[str]]:
    """Return the commands that would be run; every one succeeds, but that of seed 13."""
    seen: list[list[str]] = []

    def pretend(command):
        seen.append(command)
        failed = command[command.index("--agent.seed") + 1] == "13"
        return (3 if failed else 0), None

    monkeypatch.setattr("mjlab.scripts.train_seeds.run_forwarding_signals", pretend)
    return seen


def test_each_seed_trains_once_and_to_the_end(run, commands, monkeypatch):
    monkeypatch.setattr("mjlab.scripts.train_seeds.select_gpus", lambda ids: (None, 0))
    outcome = run("train_seeds", TASK, "--seeds", "3", "--num-envs", "64")
    assert outcome.status == 0
    assert outcome.err.count("No GPU is visible") == 1
    assert len(commands) == 3
    for seed, command in enumerate(commands, start=1):
        assert command[:4] == [sys.executable, "-m", "mjlab.scripts.train", TASK]
        flags = dict(zip(command[4::2], command[5::2], strict=True))
        assert flags == {
            "--agent.evaluation.stop-when-solved": "False",
            "--num-envs": "64",
            "--device": "cpu",
            "--agent.seed": str(seed),
            "--agent.run-name": f"seed_{seed}",
        }


# Return that every policy reaches.
CONDITIONS = {
    "return": {"solved_return": -1.0, "trigger_return": -9.0},
    "below": {"solved_below": {"mean_length": 99.0}},
    "above": {"solved_above": {"mean_length": 0.0}},
}


@pytest.fixture(
    params=["return", *(pytest.param(n, marks=pytest.mark.slow) for n in ("below", "above"))]
)
def easy(request):
    """A task that is solved from the first iteration on."""

    def rl_cfg():
        cfg = registry.load_rl_cfg(TASK)
        conditions = CONDITIONS[request.param]
        cfg.evaluation = EvaluationCfg(num_episodes=4, min_interval=1, **conditions)
        return cfg

    registry.register_mjlab_task("Test-Easy", registry._tasks[TASK].env_cfg, rl_cfg=rl_cfg)
    yield "Test-Easy"
    del registry._tasks["Test-Easy"]


def test_a_solved_seed_goes_on_to_its_last_iteration_and_is_evaluated(
    run, easy, tmp_path, monkeypatch
):
    monkeypatch.setattr("mjlab.scripts.train_seeds.run_forwarding_signals", _run_here(run))
    flags = ["--seeds", "1", "--log-root", str(tmp_path), "--agent.max-iterations", "3"]
    outcome = run("train_seeds", easy, *SMALL[:-4], *flags, "--env.episode-length-s", "0.2")
    assert outcome.status == 0, outcome.err
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    info = Run(run_dir).info
    assert (info["ended"], info["iterations"]) == ("finished", 3)
    iterations, _ = read_scalars(run_dir, "Evaluation/mean_return")
    assert list(iterations) == [0, 1, 2]


def _run_here(run):
    """Return a runner of training commands in this process, faster than a subprocess."""

    def run_here(command):
        outcome = run("train", *command[3:])
        assert outcome.status == 0, outcome.err
        return outcome.status, None

    return run_here


def test_five_seeds_are_the_default(run, commands):
    assert run("train_seeds", TASK).status == 0
    assert len(commands) == 5


@pytest.mark.parametrize("count", ["0", "-2", "many", "10001", None])
def test_the_number_of_seeds_is_positive(run, commands, count):
    flags = ["--seeds"] if count is None else ["--seeds", count]
    outcome = run("train_seeds", TASK, *flags)
    assert outcome.status != 0
    assert "--seeds" in outcome.out + outcome.err
    assert not commands


def test_a_seed_that_fails_ends_the_series_and_is_named(run, commands):
    outcome = run("train_seeds", TASK, "--seeds", "20")
    assert outcome.status == 1
    assert "seed 13 ended with status 3" in outcome.message
    assert len(commands) == 13


def test_an_unknown_task_trains_nothing(run, commands):
    assert run("train_seeds", "No-Task").status == 1
    assert not commands


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_reaches_the_run_which_is_waited_for(tmp_path, name):
    done = tmp_path / "saved"
    child = (
        "import signal, sys, time, pathlib\n"
        "def save(*_):\n"
        f"    time.sleep(0.5); pathlib.Path({str(done)!r}).touch(); sys.exit(0)\n"
        f"signal.signal(signal.{name}, save)\n"
        f"pathlib.Path({str(tmp_path / 'ready')!r}).touch()\n"
        "time.sleep(30)\n"
    )
    parent = (
        "import sys\n"
        "from mjlab.scripts.train_seeds import run_forwarding_signals\n"
        f"print(run_forwarding_signals([sys.executable, '-c', {child!r}]))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 20
    while not (tmp_path / "ready").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(getattr(signal, name))
    output, _ = process.communicate(timeout=20)
    assert output.strip() == f"(0, <Signals.{name}: {int(getattr(signal, name))}>)"
    assert done.exists()


@pytest.mark.slow
def test_ctrl_c_saves_the_running_seed_and_ends_the_series(tmp_path):
    command = [sys.executable, "-m", "mjlab.scripts.train_seeds", TASK, *SMALL[:-4]]
    command += ["--log-root", str(tmp_path), "--agent.max-iterations", "1000000", "--seeds=2"]
    command += ["--agent.save-interval", "1"]
    out = interrupt_training(command, tmp_path)
    assert "Stopped during seed 1 of 2" in out


@pytest.mark.parametrize(("child", "received", "status"), [
    (130, None, 130), (143, None, 143), (-15, None, 143), (143, signal.SIGHUP, 129), (0, signal.SIGTERM, 143),
])  # fmt: skip
def test_an_interrupted_seed_ends_the_series(run, monkeypatch, child, received, status):
    trained = []

    def pretend(command):
        trained.append(command)
        return (child, received) if len(trained) == 2 else (0, None)

    monkeypatch.setattr("mjlab.scripts.train_seeds.run_forwarding_signals", pretend)
    outcome = run("train_seeds", TASK, "--seeds", "3", "--device", "cpu")
    assert (outcome.status, outcome.err) == (status, "")
    assert len(trained) == 2
    assert "Stopped during seed 2 of 3" in outcome.out


def test_the_help_of_a_task_tells_of_seeds_and_the_flags_of_train(run, commands):
    outcome = run("train_seeds", TASK, "--help")
    assert outcome.status == 0
    assert "--seeds INT" in outcome.out
    assert "--num-envs" in outcome.out
    assert not commands


def test_a_mistaken_flag_is_told_before_anything_is_trained(run, commands):
    assert run("train_seeds", TASK, "--no-such-flag", "3").status == 2
    assert not commands


def test_seeds_may_be_given_with_an_equals_sign(run, commands):
    assert run("train_seeds", TASK, "--seeds=2").status == 0
    assert len(commands) == 2
