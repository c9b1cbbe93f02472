"""`mjlab sweep`: settings and seeds side by side, continued and compared."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import functools
import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import TASK

from mjlab.cli import main as cli
from mjlab.cli.train_config import TrainConfig, return_differences
from mjlab.managers import CurriculumTermCfg, TerminationTermCfg
from mjlab.rl.config import EvaluationCfg
from mjlab.runs import Run
from mjlab.runs.folder import write_info, write_params
from mjlab.runs.reference import read_scalars_of_sessions
from mjlab.sweep.objective import choose_objective
from mjlab.sweep.settings import Axis, Sweep
from mjlab.utils.errors import BadCallError

optuna = pytest.importorskip("optuna")

RATE = "agent.algorithm.learning-rate"
LEARNING = ("--over", f"{RATE}=1e-4,1e-3")


class Machine:
    """Stand-in for the processes of `train`.

    The return of a run is 1e4 times its learning rate, or `results` of its flags.
    """

    def __init__(self) -> None:
        self.commands: list[list[str]] = []
        self.environments: list[dict[str, str]] = []
        self.at_once = 0
        self.interrupts_after = 99
        self.fails: tuple[str, ...] = ()
        self.writes = True
        self.status_of_interrupted = 130
        self.stopped_alone = ""
        self.results = lambda flags: {"mean_return": 1e4 * float(flags[f"--{RATE}"])}
        self._alive = 0

    def start(self, command, environment, output):
        """Return a process that trains when it is asked for its status."""
        self.commands.append(command)
        self.environments.append(environment)
        self._alive += 1
        self.at_once = max(self.at_once, self._alive)
        process = SimpleNamespace(signals=[], wait=lambda: 0, returncode=None)
        process.send_signal = process.signals.append
        process.poll = lambda: self._end(process, command, output)
        return process

    def _end(self, process, command, output) -> int | None:
        flags = flags_of(command)
        if len(self.commands) >= self.interrupts_after:
            if not process.signals:
                signal.raise_signal(signal.SIGINT)
                return None
            ended = "interrupted"
        elif flags["--agent.seed"] == self.stopped_alone:
            self.stopped_alone, ended = "", "interrupted"
        else:
            ended = "failed" if flags.get(f"--{RATE}") in self.fails else "finished"
        self._alive -= 1
        run_dir = Path(flags["--log-root"], flags["--agent.experiment-name"])
        run_dir /= f"2026-01-01_{len(self.commands)}_{flags['--agent.run-name']}"
        if self.writes:
            write_run(run_dir, ended, self.results(flags), command)
        output.write(b"error: the pole broke\n" if ended == "failed" else b"[3/3] 0:03\n")
        status = {"failed": 1, "interrupted": self.status_of_interrupted}
        process.returncode = status.get(ended, 0)
        return process.returncode


def flags_of(command: list[str]) -> dict[str, str]:
    """Return the flags of a command of `train`, the last of each name."""
    words = iter(command[4:])
    pairs = (word.split("=", 1) if "=" in word else (word, next(words)) for word in words)
    return dict(pairs)


def write_run(run_dir: Path, ended: str, results: dict[str, float], command: list[str]) -> None:
    """Write a run folder as training does."""
    from torch.utils.tensorboard import SummaryWriter

    run_dir.mkdir(parents=True)
    agent = TrainConfig.from_task(TASK).agent
    write_params(run_dir, agent, agent)
    write_info(run_dir, task=TASK, learner="ppo", command=command, ended=ended, iterations=3)
    (run_dir / "model_2.pt").touch()
    with SummaryWriter(str(run_dir)) as writer:
        for i in range(3):
            writer.add_scalar("Perf/collection_time", 1.0, i)
            writer.add_scalar("Perf/learning_time", 1.0, i)
            writer.add_scalar("Perf/evaluation_time", 2.0, i)
            for name, value in results.items():
                writer.add_scalar(f"Evaluation/{name}", value * (i + 1) / 3, i)


@pytest.fixture
def machine(monkeypatch) -> Machine:
    """Two cores, and processes that do not train."""
    machine = Machine()
    monkeypatch.setattr("mjlab.sweep.runs.start_in_background", machine.start)
    monkeypatch.setattr("mjlab.sweep.runs.send_signal", lambda process, n: process.send_signal(n))
    monkeypatch.setattr("mjlab.sweep.runs.available_cores", lambda: 2)
    monkeypatch.setattr("mjlab.sweep.runs._SECONDS_BETWEEN_LOOKS", 0.0)
    return machine


@pytest.fixture(scope="module")
def database(tmp_path_factory) -> Path:
    """Return an empty database: creating its tables takes most of the time of a test."""
    path = tmp_path_factory.mktemp("database") / "study.db"
    optuna.storages.RDBStorage(f"sqlite:///{path.as_posix()}")
    return path


@pytest.fixture
def folder(database, tmp_path) -> Path:
    """Return the folder of a new sweep."""
    (tmp_path / "mine").mkdir()
    return Path(shutil.copy(database, tmp_path / "mine")).parent


@pytest.fixture
def sweep(run_main):
    """Return a function that runs `mjlab sweep`."""
    flags = ("--num-envs", "16", "--device", "cpu")

    def sweep(*argv: str, task: str = TASK):
        return run_main(cli.main, "mjlab", "sweep", task, *argv, *flags)

    return sweep


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of the table."""
    with (folder / "table.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_combinations_and_seeds_run_side_by_side_once_and_are_compared(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder))
    outcome = sweep(*argv, "--seeds", "2")
    assert outcome.status == 0, outcome.err
    flags = [flags_of(command) for command in machine.commands]
    assert [(f[f"--{RATE}"], f["--agent.seed"]) for f in flags] == [
        ("1e-4", "1"), ("1e-4", "2"), ("1e-3", "1"), ("1e-3", "2"),
    ]  # fmt: skip
    assert {f["--num-envs"] for f in flags} == {"16"}
    assert machine.at_once == 2
    assert {(e["MJLAB_CORES"], e["OMP_NUM_THREADS"]) for e in machine.environments} == {("1", "1")}
    best, other = rows_of(folder)
    assert (best["learning-rate"], float(best["mean_return"]), best["seeds"]) == ("1e-3", 10.0, "2")
    assert float(other["mean_return"]) == pytest.approx(1.0)
    assert "| 1e-3 " in (folder / "table.md").read_text(encoding="utf-8")
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    commands = [line for line in outcome.out.splitlines() if line.startswith("    uv run ")]
    assert [line.split()[2:4] for line in commands] == [["mjlab", "train"], ["mjlab", "play"]]
    assert f"--{RATE}=1e-3" in commands[0]
    # Again: finished runs are kept, and more seeds are added to them.
    assert sweep(*argv, "--seeds", "2").status == 0
    assert len(machine.commands) == 4
    assert sweep(*argv, "--seeds", "3").status == 0
    assert [flags_of(command)["--agent.seed"] for command in machine.commands[4:]] == ["3", "3"]


def test_ctrl_c_stops_all_runs_and_the_same_command_resumes_them(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder), "--seeds", "2")
    machine.interrupts_after = 3
    outcome = sweep(*argv)
    assert outcome.status == 130
    assert f"uv run mjlab sweep {TASK} {' '.join(argv)}" in outcome.out
    stopped = len(machine.commands)
    machine.interrupts_after = 99
    assert sweep(*argv).status == 0
    resumed = [flags_of(command) for command in machine.commands[stopped:]]
    assert [f.get("--agent.resume") for f in resumed[:1]] == ["True"]
    # Each run was begun once.
    begun = [f for f in map(flags_of, machine.commands) if "--agent.resume" not in f]
    assert len({(f[f"--{RATE}"], f["--agent.seed"]) for f in begun}) == len(begun) == 4
    assert [row["seeds"] for row in rows_of(folder)] == ["2", "2"]


@pytest.mark.parametrize(
    "status",
    [
        130,
        -15,
    ],
)
def test_interrupted_runs_are_not_failed(sweep, machine, folder, status):
    machine.interrupts_after, machine.status_of_interrupted = 3, status
    outcome = sweep(*LEARNING, "--folder", str(folder), "--seeds", "2")
    assert outcome.status == 130
    assert "Failed" not in outcome.out
    assert outcome.out.count("Saved  ") >= 1
    assert {row["state"] for row in rows_of(folder)} <= {"finished", "interrupted"}
    left = re.search(r"Interrupted; (\d) runs? left", outcome.out)
    assert left is not None
    assert int(left[1]) == 4 - sum(int(row["seeds"] or 0) for row in rows_of(folder))
    machine.interrupts_after = 99
    assert sweep(*LEARNING, "--folder", str(folder), "--seeds", "2").status == 0
    assert [row["state"] for row in rows_of(folder)] == ["finished", "finished"]


def test_a_run_stopped_alone_is_resumed(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder), "--seeds", "2")
    machine.stopped_alone, machine.status_of_interrupted = "1", 143
    outcome = sweep(*argv)
    assert outcome.status == 143
    assert "Failed" not in outcome.out
    assert [row["state"] for row in rows_of(folder)] == ["interrupted", "waiting"]
    assert sweep(*argv).status == 0
    resumed = [flags_of(c) for c in machine.commands if "--agent.resume" in flags_of(c)]
    assert [flags["--agent.seed"] for flags in resumed] == ["1"]
    assert [row["state"] for row in rows_of(folder)] == ["finished", "finished"]


LIFT, LIFT_WEIGHT = "Mjlab-Lift-Cube-Yam", "env.rewards.lift.weight"


def by_weight(flags: dict[str, str]) -> dict[str, float]:
    """Return results of a weight: the higher it is, the higher the return, and the fewer successes."""
    weight = float(flags[f"--{LIFT_WEIGHT}"])
    return {
        "mean_return": 100.0 * weight,
        "success_rate": 1.0 / weight,
        "position_error": 0.1 * weight,
        "failure_rate": 0.0,
    }


def test_reward_weights_are_compared_by_success(sweep, machine, folder):
    machine.results = by_weight
    argv = ("--over", f"{LIFT_WEIGHT}=10,1", "--seeds", "3", "--folder", str(folder))
    outcome = sweep(*argv, task=LIFT)
    assert outcome.status == 0, outcome.err
    assert "compared by success_rate, because the settings change the reward" in outcome.out
    assert "Best: weight=1, success_rate 1" in outcome.out
    assert [(row["weight"], float(row["success_rate"])) for row in rows_of(folder)] == [
        ("1", 1.0), ("10", pytest.approx(0.1)),
    ]  # fmt: skip
    assert "mean_return" not in rows_of(folder)[0]
    assert f"--{LIFT_WEIGHT}=1" in outcome.out.partition("Next")[2]
    # The task has no goal, and is evaluated all the same.
    assert {"--agent.evaluation.trigger-return"} <= flags_of(machine.commands[0]).keys()


def test_a_return_does_not_rank_reward_weights(sweep, machine, folder):
    machine.results = by_weight
    argv = ("--over", f"{LIFT_WEIGHT}=10,1", "--folder", str(folder))
    outcome = sweep(*argv, "--objective", "Evaluation/mean_return", task=LIFT)
    assert outcome.status == 0, outcome.err
    assert "not ranked" in outcome.out
    assert "leave out --objective to compare success_rate" in outcome.out
    assert not {"Best", "Highest", "Next"} & set(re.findall(r"^\w+", outcome.out, re.MULTILINE))


@pytest.mark.slow
def test_weights_of_a_range_are_sampled_and_compared_by_success(sweep, machine, folder):
    machine.results = by_weight
    argv = ("--over", f"{LIFT_WEIGHT}=1..10", "--trials", "3", "--folder", str(folder))
    outcome = sweep(*argv, task=LIFT)
    assert outcome.status == 0, outcome.err
    weights = [float(row["weight"]) for row in rows_of(folder)]
    assert weights == sorted(weights)
    assert "compared by success_rate" in outcome.out


@pytest.mark.slow
def test_goals_in_returns_neither_rank_nor_stop(sweep, machine, folder):
    machine.results = lambda flags: {"mean_return": 900.0}
    stop = "--agent.evaluation.stop-when-solved"
    argv = ("--over", "env.rewards.smooth-reward.weight=1,10", "--folder", str(folder))
    outcome = sweep(*argv, f"{stop}=True")
    assert outcome.status == 0, outcome.err
    assert "define success or metrics" in outcome.out
    assert "return of 900" in outcome.out
    assert "Best" not in outcome.out
    assert all(flags_of(command)[stop] == "False" for command in machine.commands)


def test_a_weight_of_all_runs_is_named_beside_the_goal(sweep, machine, folder):
    argv = (*LEARNING, "--env.rewards.smooth-reward.weight", "9", "--folder", str(folder))
    outcome = sweep(*argv)
    assert "Best" in outcome.out or "Highest" in outcome.out
    assert "goal of return 900" in outcome.err
    assert "rewards.smooth_reward.weight" in outcome.err


def test_noise_is_not_called_best(sweep, machine, folder):
    returns = {("1e-4", "1"): 10.0, ("1e-4", "2"): 12.0, ("1e-3", "1"): 9.0, ("1e-3", "2"): 14.0}
    machine.results = lambda flags: {
        "mean_return": returns[flags[f"--{RATE}"], flags["--agent.seed"]]
    }
    argv = (*LEARNING, "--folder", str(folder))
    assert "Best" not in sweep(*argv).out
    outcome = sweep(*argv, "--seeds", "2")
    assert "not distinguishable from learning-rate=1e-4 with 2 seeds" in outcome.out
    assert "Best" not in outcome.out
    first = rows_of(folder)[0]
    # Mean of 9 and 14, and Student's t of one degree of freedom.
    half = 12.706 * 2.5
    assert float(first["mean_return"]) == pytest.approx(11.5)
    assert float(first["low"]) == pytest.approx(11.5 - half, abs=0.01)
    assert float(first["high"]) == pytest.approx(11.5 + half, abs=0.01)


def test_what_is_left_and_evaluations_are_shown(sweep, machine, folder):
    outcome = sweep(*LEARNING, "--folder", str(folder), "--seeds", "2")
    left = [int(n) for n in re.findall(r"(\d+) runs? left", outcome.out)]
    assert left == [3, 2, 1, 0]
    # Two seconds of evaluation after two of collecting and learning.
    assert "evaluations take 50% of the time" in outcome.out
    assert {row["evaluating"] for row in rows_of(folder)} == {"50%"}


def cfg_of(task: str, **env: Any) -> TrainConfig:
    cfg = TrainConfig.from_task(task)
    for name, value in env.items():
        setattr(cfg.env, name, value)
    return cfg


def weighted(task: str, factor: float) -> TrainConfig:
    """Return the config of a task with the weight of its first reward multiplied."""
    cfg = TrainConfig.from_task(task)
    term = next(term for term in cfg.env.rewards.values() if term is not None)
    term.weight *= factor
    return cfg


@pytest.mark.parametrize(
    ("task", "tag", "is_low"),
    [
        (LIFT, "Evaluation/success_rate", False),
        ("Mjlab-Tracking-Flat-Unitree-G1", "Evaluation/success_rate", False),
        ("Mjlab-Velocity-Flat-Unitree-Go1", "Evaluation/lin_vel_error", True),
    ],
)
def test_bundled_tasks_have_a_measure_without_the_return(task, tag, is_low):
    objective = choose_objective(task, [weighted(task, 1.0), weighted(task, 3.0)])
    assert (objective.tag, objective.minimize, objective.is_ranked) == (tag, is_low, True)
    assert "change the reward" in objective.reason


@pytest.mark.parametrize(
    "changed",
    [
        {"decimation": 10},
        {"episode_length_s": 25.0},
        {"scale_rewards_by_dt": False},
        {"rewards": {}},
        {"rewards": {"smooth_reward": None}},
        {"curriculum": {"grow": CurriculumTermCfg(func=print)}},
        {"terminations": {}},
    ],
)
def test_what_enters_a_return_is_not_compared_by_it(changed):
    cfgs = [cfg_of(TASK), cfg_of(TASK, **changed)]
    objective = choose_objective(TASK, cfgs)
    assert not objective.is_ranked
    assert next(iter(changed)) in objective.reason
    for cfg in cfgs:
        cfg.agent.evaluation = EvaluationCfg(success="builtins:len", solved_return=900.0)
    assert choose_objective(TASK, cfgs).tag == "Evaluation/success_rate"


def test_parameters_and_time_steps_enter_the_return():
    first, second, third = (TrainConfig.from_task(TASK) for _ in range(3))
    second.env.rewards["smooth_reward"].params["scale"] = 2.0
    third.env.sim.mujoco.timestep = 0.005
    assert return_differences(first.env, second.env) == ["rewards.smooth_reward.params.scale"]
    assert return_differences(first.env, third.env) == ["sim.mujoco.timestep"]
    assert return_differences(first.env, TrainConfig.from_task(TASK).env) == []


@pytest.mark.parametrize(
    ("evaluation", "tag", "is_low"),
    [
        (EvaluationCfg(success=900.0), None, False),
        (EvaluationCfg(solved_above={"success_rate": 0.9}, success=1.0), None, False),
        (EvaluationCfg(success="survival"), "Evaluation/success_rate", False),
        (EvaluationCfg(metrics={"lag_error": len}), "Evaluation/lag_error", True),
        (EvaluationCfg(metrics={"lag": len}, solved_below={"lag": 1.0}), "Evaluation/lag", True),
        (
            EvaluationCfg(metrics={"speed": len}, solved_above={"speed": 1.0}),
            "Evaluation/speed",
            False,
        ),
        # Unknown direction.
        (EvaluationCfg(metrics={"speed": len}), None, False),
    ],
)
def test_success_by_a_return_counts_as_the_return(evaluation, tag, is_low):
    cfgs = [weighted(TASK, 1.0), weighted(TASK, 10.0)]
    for cfg in cfgs:
        cfg.agent.evaluation = evaluation
    objective = choose_objective(TASK, cfgs)
    assert objective.is_ranked == (tag is not None)
    if tag is not None:
        assert (objective.tag, objective.minimize) == (tag, is_low)
    else:
        assert "metrics" in objective.reason or "Evaluation/speed" in objective.reason
        # Users may choose.
        assert choose_objective(TASK, cfgs, "Train/mean_episode_length").is_ranked
        assert not choose_objective(TASK, cfgs, "Evaluation/success_rate").is_ranked
        assert not choose_objective(TASK, cfgs, "Train/exploring_return").is_ranked


def test_endless_episodes_are_not_ranked():
    cfgs = [weighted(TASK, 1.0), weighted(TASK, 10.0)]
    for cfg in cfgs:
        cfg.env.episode_length_s = 1e9
        cfg.agent.evaluation = EvaluationCfg(success="builtins:len")
    objective = choose_objective(TASK, cfgs)
    assert not objective.is_ranked
    assert "episode_length_s" in objective.reason


def test_failures_rank_tasks_that_can_fail():
    fell = TerminationTermCfg(func=len)
    cfgs = [weighted(TASK, 1.0), weighted(TASK, 10.0)]
    for cfg in cfgs:
        cfg.env.terminations["fell"] = fell
    objective = choose_objective(TASK, cfgs)
    assert (objective.tag, objective.minimize) == ("Evaluation/failure_rate", True)
    # Failures are not comparable if the settings change what a failure is.
    cfgs[1].env.terminations["fell"] = TerminationTermCfg(func=len, params={"angle": 1.0})
    assert not choose_objective(TASK, cfgs).is_ranked


def test_other_settings_are_compared_by_the_return():
    cfgs = [TrainConfig.from_task(TASK), TrainConfig.from_task(TASK)]
    cfgs[1].agent.max_iterations = 3
    objective = choose_objective(TASK, cfgs)
    assert (objective.tag, objective.is_ranked) == ("Evaluation/mean_return", True)
    assert (objective.reason, objective.past_goal) == ("", None)


def test_a_closed_terminal_does_not_keep_runs_from_saving(sweep, machine, folder, monkeypatch):
    def print_(*words: Any, **options: Any) -> None:
        if "Saving" in words[0]:
            raise OSError(5, "Input/output error")
        print(*words, **options)

    monkeypatch.setattr("mjlab.sweep.runs.print", print_, raising=False)
    machine.interrupts_after = 2
    outcome = sweep(*LEARNING, "--folder", str(folder), "--jobs", "2")
    assert outcome.status == 130
    assert "Saved" in outcome.out


def test_a_failed_run_is_named_and_retried_by_the_same_command(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder))
    machine.fails = ("1e-4",)
    outcome = sweep(*argv)
    assert outcome.status == 1
    assert "the pole broke" in outcome.out
    assert str(folder / "runs" / "learning-rate=1e-4" / "seed_1.log") in outcome.message
    assert [row["state"] for row in rows_of(folder)] == ["finished", "failed"]
    machine.fails = ()
    assert sweep(*argv).status == 0
    assert [flags_of(command)[f"--{RATE}"] for command in machine.commands] == [
        "1e-4", "1e-3", "1e-4",
    ]  # fmt: skip
    assert len(rows_of(folder)) == 2


def test_a_run_whose_resumption_fails_is_not_called_saved(sweep, machine, folder):
    argv = ("--over", f"{RATE}=1e-4,1e-3", "--folder", str(folder), "--jobs", "1")
    machine.interrupts_after = 1
    assert sweep(*argv).status == 130
    # Its folder still says that the run was interrupted.
    machine.interrupts_after, machine.fails, machine.writes = 99, ("1e-4",), False
    outcome = sweep(*argv)
    assert outcome.status == 1
    assert "Failed   learning-rate=1e-4" in outcome.out
    assert "Saved" not in outcome.out


@pytest.mark.slow
def test_values_of_ranges_are_sampled(sweep, machine, folder):
    argv = ("--over", f"{RATE}=1e-5..1e-2:log", "--folder", str(folder))
    assert sweep(*argv, "--trials", "1").status == 0
    assert sweep(*argv, "--trials", "3").status == 0
    sampled = {float(flags_of(command)[f"--{RATE}"]) for command in machine.commands}
    assert len(sampled) == len(machine.commands) == 3
    assert all(1e-5 <= rate <= 1e-2 for rate in sampled)
    returns = [float(row["mean_return"]) for row in rows_of(folder)]
    assert returns == sorted(returns, reverse=True)


@pytest.fixture
def storage(request, folder, tmp_path) -> Iterator[str]:
    """A storage that machines share: a database, a journal file or a proxy of a database."""
    database = f"sqlite:///{(folder / 'study.db').as_posix()}"
    if request.param == "proxy":
        with socket.socket() as probe:
            probe.bind(("localhost", 0))
            port = probe.getsockname()[1]
        served = optuna.storages.get_storage(database)
        serve = functools.partial(optuna.storages.run_grpc_proxy_server, served, port=port)
        threading.Thread(target=serve, daemon=True).start()
        yield f"grpc://localhost:{port}"
    else:
        yield database if request.param == "database" else str(tmp_path / "both.journal")


@pytest.mark.filterwarnings("ignore:.*run_grpc_proxy_server is experimental")
@pytest.mark.parametrize("storage", ["database", "journal", "proxy"], indirect=True)
def test_machines_share_the_settings_of_a_study(sweep, machine, storage, tmp_path):
    first, second = (
        (*LEARNING, "--storage", storage, "--jobs", "1", "--folder", str(tmp_path / name / "both"))
        for name in ("first", "second")
    )
    machine.interrupts_after = 1
    assert sweep(*first).status == 130
    machine.interrupts_after = 99
    # The setting of the first machine is left to it.
    assert sweep(*second).status == 0
    assert [flags_of(command)[f"--{RATE}"] for command in machine.commands] == ["1e-4", "1e-3"]
    assert sweep(*first).status == 0
    assert flags_of(machine.commands[2])["--agent.resume"] == "True"
    assert len(machine.commands) == 3
    rows = rows_of(tmp_path / "first" / "both")
    assert [(row["learning-rate"], row["state"]) for row in rows] == [
        ("1e-3", "elsewhere"), ("1e-4", "finished"),
    ]  # fmt: skip


def later(study: Path, minutes: float) -> None:
    """Let time pass since the last heartbeats in a database."""
    with contextlib.closing(sqlite3.connect(study, isolation_level=None)) as base:
        base.execute(
            f"UPDATE trial_heartbeats SET heartbeat = datetime(heartbeat, '-{minutes} minutes')"
        )


@pytest.mark.parametrize(("minutes", "returns"), [(5, False), (15, True)])
def test_settings_of_a_machine_that_died_return(sweep, machine, folder, tmp_path, minutes, returns):
    study = folder / "study.db"
    flags = (*LEARNING, "--storage", f"sqlite:///{study.as_posix()}", "--jobs", "1", "--folder")
    dead, alive = (str(tmp_path / name / "both") for name in ("dead", "alive"))
    machine.interrupts_after = 1
    assert sweep(*flags, dead).status == 130
    machine.interrupts_after = 99
    later(study, minutes)
    assert sweep(*flags, alive).status == 0
    trained = [flags_of(command)[f"--{RATE}"] for command in machine.commands[1:]]
    assert sorted(trained) == (["1e-3", "1e-4"] if returns else ["1e-3"])
    # The machine is repaired.
    assert sweep(*flags, dead).status == 0
    resumed = [command for command in machine.commands if "--agent.resume" in flags_of(command)]
    assert len(resumed) == (0 if returns else 1)
    states = {row["learning-rate"]: row["state"] for row in rows_of(Path(alive))}
    assert states["1e-3"] == "finished"
    assert states["1e-4"] == ("finished" if returns else "elsewhere, running")


def test_a_machine_that_returns_in_time_keeps_its_settings(sweep, machine, folder, tmp_path):
    study = folder / "study.db"
    flags = (*LEARNING, "--storage", f"sqlite:///{study.as_posix()}", "--jobs", "1", "--folder")
    mine = str(tmp_path / "mine" / "both")
    machine.interrupts_after = 1
    assert sweep(*flags, mine).status == 130
    later(study, 15)
    machine.interrupts_after = 99
    assert sweep(*flags, mine).status == 0
    assert "--agent.resume" in flags_of(machine.commands[1])
    assert len(machine.commands) == 3


@pytest.mark.parametrize("storage", ["journal"], indirect=True)
def test_settings_of_lost_folders_are_trained_after_they_are_told_as_failed(
    sweep, machine, storage, tmp_path
):
    flags = (*LEARNING, "--storage", storage, "--jobs", "1", "--folder")
    lost, other = (str(tmp_path / name / "both") for name in ("lost", "other"))
    machine.interrupts_after = 1
    assert sweep(*flags, lost).status == 130
    machine.interrupts_after = 99
    journal = optuna.storages.journal.JournalFileBackend(storage)
    study = optuna.load_study(study_name=None, storage=optuna.storages.JournalStorage(journal))
    (trial,) = (one for one in study.trials if one.state.name == "RUNNING")
    study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    assert sweep(*flags, other).status == 0
    assert [row["state"] for row in rows_of(Path(other))] == ["finished", "finished"]


@pytest.mark.parametrize(
    ("storage", "named"),
    [
        ("grpc://localhost:1", "run_grpc_proxy_server"),
        ("{}/missing/both.journal", "journal file"),
        ("{}/mine", "journal file"),
        ("nosuch://user@host/database", "postgresql://"),
    ],
)
def test_an_unusable_storage_is_named_with_the_cure(
    sweep, machine, folder, tmp_path, monkeypatch, storage, named
):
    monkeypatch.setattr("mjlab.sweep.storage._PATIENCE_S", 0.1)
    argv = ("--storage", storage.format(tmp_path), "--folder", str(folder))
    message = sweep(*LEARNING, *argv).message
    assert "--storage" in message
    assert named in message
    assert not machine.commands


def test_a_sweep_runs_once_at_a_time_and_keeps_its_flags(sweep, machine, folder):
    from mjlab.sweep.study import only_process

    argv = ("--folder", str(folder))
    with only_process(folder):
        assert "another process" in sweep(*LEARNING, *argv).message
    assert sweep(*LEARNING, *argv).status == 0
    assert "another --folder" in sweep("--over", f"{RATE}=1e-4", *argv).message
    outcome = sweep(*LEARNING, *argv, "--objective", "Evaluation/mean_retrun")
    assert "'Evaluation/mean_return'" in outcome.message
    assert len(machine.commands) == 2


def test_tables_that_cannot_be_written_are_warnings(sweep, machine, folder):
    for name in ("table.csv", "table.md", "curves.png"):
        (folder / name).mkdir()
    outcome = sweep(*LEARNING, "--folder", str(folder))
    assert outcome.status == 0
    assert "Best:" in outcome.out or "Highest:" in outcome.out
    for name in ("table.csv", "table.md", "curves.png"):
        assert f"Not written: {name}: " in outcome.err


SAMPLED = ("--over", f"{RATE}=1e-5..1e-2:log", "--trials", "2")
MIXED = (*SAMPLED[:2], "--over", "agent.algorithm.num-learning-epochs=1..9", "--trials", "3")


@pytest.mark.parametrize(
    ("over", "damage"),
    [
(LEARNING, b"garbage" * 99),
pytest.param(MIXED, None, marks=pytest.mark.slow),
],
)  # fmt: skip
def test_damaged_studies_are_rebuilt_from_the_folders(sweep, machine, folder, over, damage):
    argv = (*over, "--folder", str(folder))
    assert sweep(*argv).status == 0
    rows, trained = rows_of(folder), len(machine.commands)
    study = folder / "study.db"
    if damage == "flip":
        content = study.read_bytes()
        study.write_bytes(content.replace(b"learning-rate", b"learnimg-rate"))
    else:
        study.unlink() if damage is None else study.write_bytes(damage)
    outcome = sweep(*argv)
    if damage:
        assert outcome.status == 1
        assert f"{study} is damaged" in outcome.message
        assert "delete it; the next call rebuilds it from the folders" in outcome.message
        study.unlink()
        outcome = sweep(*argv)
    assert outcome.status == 0
    assert rows_of(folder) == rows
    assert len(machine.commands) == trained


@pytest.mark.slow
def test_a_lost_definition_keeps_the_trials(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder))
    assert sweep(*argv).status == 0
    rows = rows_of(folder)
    (folder / "sweep.json").unlink()
    assert sweep(*argv).status == 0
    assert rows_of(folder) == rows
    assert len(machine.commands) == 2


@pytest.mark.parametrize(
    "content",
    [
        "",
        '{"id": 3}',
    ],
)
def test_a_damaged_definition_is_named_with_its_cure(sweep, machine, folder, content):
    argv = (*LEARNING, "--folder", str(folder))
    path = folder / "sweep.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert f"{path} is damaged" in (message := sweep(*argv).message)
    assert "delete it" in message
    path.unlink()
    assert sweep(*argv).status == 0


def test_a_locked_study_is_not_called_damaged(sweep, machine, folder):
    study = folder / "study.db"
    with contextlib.closing(sqlite3.connect(study, isolation_level=None)) as base:
        base.execute("BEGIN EXCLUSIVE")
        message = sweep(*LEARNING, "--folder", str(folder)).message
    assert f"{study}: cannot be read and written: database is locked" in message
    assert "delete" not in message


def test_runs_without_values_are_named_with_the_cure(sweep, machine, folder):
    argv = (*LEARNING, "--folder", str(folder))
    assert sweep(*argv).status == 0
    events = next(folder.glob("runs/*1e-4/*/events*"))
    for content in (b"", None):
        events.unlink() if content is None else events.write_bytes(content)
        message = sweep(*argv).message
        assert str(events.parent) in message
        assert "elete " in message
    shutil.rmtree(events.parent)
    assert sweep(*argv).status == 0
    assert len(machine.commands) == 3


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ((), "--over"),
        (("--over", RATE), RATE),
        (("--over", f"{RATE}=1e-4,,1e-3"), RATE),
        (("--over", f"{RATE}=1e-2..1e-4", "--trials", "3"), RATE),
        (("--over", f"{RATE}=0..1:log", "--trials", "3"), RATE),
        (("--over", f"{RATE}=1e-4..1e-3"), "--trials"),
        ((*LEARNING, *LEARNING), RATE),
        ((*LEARNING, f"--{RATE}", "1"), RATE),
        ((*LEARNING, "--agent.seed", "3"), "--seeds"),
        (("--over", "agent.resume=True,False"), "agent.resume"),
        ((*LEARNING, "--jobs", "0"), "--jobs"),
        (("--over", f"{RATE}=1e-4,nan"), RATE),
    ],
)
def test_a_wrong_flag_is_named_before_anything_runs(sweep, machine, tmp_path, flags, named):
    outcome = sweep(*flags, "--folder", str(tmp_path / "new"))
    assert outcome.status in (1, 2)
    assert named in outcome.message
    assert not machine.commands
    assert not (tmp_path / "new").exists()


def test_a_misspelt_flag_is_found_before_anything_runs(sweep, machine):
    outcome = sweep("--over", "agent.algorithm.learning-rat=1")
    assert outcome.status == 2
    assert RATE in outcome.err
    assert not machine.commands


def test_an_axis_reads_its_values():
    whole = dataclasses.replace(Axis.parse("x=1..8"), is_integer=True)
    assert [whole.value(text) for text in ("8", "9", "2.0", "")] == [8, None, None, None]
    real = Axis.parse("x=1e-4..1e-2:log")
    assert [real.value(text) for text in ("1e-3", "1", "nan", "b")] == [1e-3, None, None, None]
    assert [Axis.parse("x=1,b").value(text) for text in ("1", "1.0")] == ["1", None]


def test_values_are_split_outside_brackets():
    assert Axis.parse("a_b=[1,2],[3]").values == ("[1,2]", "[3]")
    assert Axis.parse("--a-b=1,1,2") == Axis("a-b", "1,1,2", ("1", "2"))
    axis = Axis.parse("x=-1.5..2e3")
    assert (axis.values, axis.is_range, axis.is_log) == (("-1.5", "2e3"), True, False)
    # Not a range.
    assert Axis.parse("motion=../a.npz,../b.npz").values == ("../a.npz", "../b.npz")
    with pytest.raises(BadCallError, match="FLAG=A,B"):
        Axis.parse("=1")


@pytest.mark.parametrize(
    ("flags", "jobs", "visible", "shares"),
    [
        ((), None, ["4", "6"], "4"),
        (("--gpu-ids", "[1]"), None, ["6"], "8"),
        ((), 3, ["4", "6", "4"], "2"),
        (("--device", "cpu"), None, [None] * 4, "2"),
        (("--device", "cuda:1"), None, [None], "8"),
    ],
)
def test_runs_have_a_gpu_each_or_share_the_cores(monkeypatch, flags, jobs, visible, shares):
    from mjlab.sweep.runs import machine_slots

    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    monkeypatch.setattr("mjlab.sweep.runs.available_cores", lambda: 8)
    sweep: Any = SimpleNamespace(machine_flags=flags, jobs=jobs, num_settings=2, seeds=2)
    slots = machine_slots(sweep)
    assert [slot.get("CUDA_VISIBLE_DEVICES") for slot in slots] == visible
    assert {slot["MJLAB_CORES"] for slot in slots} == {shares}


def test_runs_resume_with_iterations_left(monkeypatch, tmp_path):
    """After its last iteration, nothing would be trained, and the last evaluation stay missing."""
    agent = SimpleNamespace(max_iterations=3)
    monkeypatch.setattr(
        "mjlab.sweep.settings.train_config",
        lambda sweep, setting: SimpleNamespace(agent=agent),
    )
    values: Any = dict.fromkeys(field.name for field in dataclasses.fields(Sweep))
    sweep = Sweep(**{**values, "axes": (Axis.parse("x=1,2"),), "folder": tmp_path})
    for name, saved in (("2026-01-01_a_seed_1", (0, 1)), ("2026-01-02_a_seed_1", (2,))):
        for number in saved:
            checkpoint = sweep.runs_folder({"x": "1"}) / name / f"model_{number}.pt"
            checkpoint.parent.mkdir(parents=True, exist_ok=True)
            checkpoint.touch()
        write_info(checkpoint.parent, ended="interrupted", iterations=3)
    assert sweep.finished_run({"x": "1"}, 1) is None
    found = sweep.last_checkpoint({"x": "1"}, 1)
    assert found is not None
    assert (found.path.parent.name, found.path.name) == ("2026-01-01_a_seed_1", "model_1.pt")
    assert sweep.last_checkpoint({"x": "2"}, 1) is None


# Time (s) after which a process hangs, also on a crowded machine.
_PATIENCE = 900.0


@pytest.mark.slow
def test_a_killed_worker_of_a_journal_file_continues(tmp_path):
    command = [sys.executable, "-m", "mjlab.cli.main", "sweep", TASK, "--device", "cpu"]
    command += ["--over", f"{RATE}=1e-4,3e-4,1e-3", "--storage", str(tmp_path / "both.journal")]
    command += ["--num-envs", "4", "--jobs", "1", "--env.sim.num-threads", "1"]
    command += ["--agent.save-interval", "1", "--agent.max-iterations", "3"]
    command += ["--agent.evaluation.num-episodes", "2", "--folder"]
    folders = [tmp_path / name / "both" for name in ("killed", "other")]
    killed, other = folders
    first, second = (
        subprocess.Popen([*command, str(folder)], stdout=subprocess.PIPE) for folder in folders
    )
    # An evaluation follows, so the run does not end before it is killed.
    while not list(killed.glob("runs/*/*/model_0.pt")):
        assert first.poll() is None
        time.sleep(0.01)
    first.kill()
    first.communicate(timeout=_PATIENCE)
    second.communicate(timeout=_PATIENCE)
    assert second.returncode == 0
    # As a machine that is started again.
    assert subprocess.run([*command, str(killed)], timeout=_PATIENCE).returncode == 0
    states = {row["learning-rate"]: row["state"] for row in rows_of(killed)}
    assert sorted(states.values()) == ["elsewhere", "elsewhere", "finished"]
    (setting,) = (name for name, state in states.items() if state == "finished")
    *_, last = sorted((killed / "runs" / f"learning-rate={setting}").glob("*_seed_1/"))
    assert len(Run(last).joined) == 2
    assert Run(last).info["iterations"] == 3


@pytest.mark.slow
def test_a_sweep_that_trains_is_interrupted_and_continued(tmp_path):
    folder = tmp_path / "sweep"
    command = [sys.executable, "-m", "mjlab.cli.main", "sweep", TASK, *LEARNING, "--seeds", "2"]
    command += ["--folder", str(folder), "--device", "cpu", "--num-envs", "16", "--jobs", "2"]
    command += ["--agent.num-steps-per-env", "8", "--agent.save-interval", "1"]
    command += ["--agent.max-iterations", "2", "--agent.evaluation.num-episodes", "4"]
    process = subprocess.Popen(command, process_group=0, stdout=subprocess.PIPE, text=True)
    while not list(folder.glob("runs/*/*/model_0.pt")):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.01)
    # As a terminal does it: to the whole process group.
    os.killpg(process.pid, signal.SIGINT)
    out = process.communicate(timeout=_PATIENCE)[0]
    assert process.returncode == 130, out
    assert "To continue:" in out
    done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [row["seeds"] for row in rows_of(folder)] == ["2", "2"]
    for setting in ("1e-4", "1e-3"):
        for seed in (1, 2):
            *_, last = sorted((folder / "runs" / f"learning-rate={setting}").glob(f"*seed_{seed}"))
            assert Run(last).info["iterations"] == 2
            # Exactly the last iteration was evaluated, and no iteration is missing.
            scalars = read_scalars_of_sessions(last)
            assert sorted(scalars["Perf/collection_time"]) == [0, 1]
            assert max(scalars["Evaluation/mean_return"]) == 1
