"""Training as processes: runs that are ended from outside, and runs of several processes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from commands import SMALL, TASK, interrupt_training, stopped_after
from process_runs import SMALL as SMALL_PROCESS
from process_runs import Ended, ProcessRun
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mjlab.cli.train_config import parse_train_flags
from mjlab.cli.training import training_env
from mjlab.rl.checkpoint import load_checkpoint
from mjlab.rl.plot import read_scalars
from mjlab.runs import Run
from mjlab.utils.processes import ProcessRank, available_cores
from mjlab.utils.random import process_seed

PATIENCE = 60.0


def endless_run(log_root: Path) -> list[str]:
    command = [sys.executable, "-m", "mjlab.scripts.train", TASK, *SMALL]
    return [*command, "--log-root", str(log_root), "--agent.max-iterations", "1000000"]


def start_endless_run(log_root: Path, *flags: str) -> subprocess.Popen[str]:
    # One thread, as in the runs that these are compared with.
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [*endless_run(log_root), *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
    )


def wait_for_checkpoint(log_root: Path, process: subprocess.Popen[str], name: str) -> None:
    end = time.monotonic() + PATIENCE
    while not list(log_root.glob(f"cartpole/*/{name}")):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end, f"no {name} after {PATIENCE} s"
        time.sleep(0.01)


def assert_resumes_exactly(
    train, log_root: Path, run_dir: Path, tmp_path: Path, *flags: str
) -> Path:
    """Resume what is in `run_dir`, and compare with a run that was never ended."""
    last = [c.path for c in Run(run_dir).checkpoints][-1]
    iterations = load_checkpoint(last)["iterations_finished"] + 2
    resumed = train(log_root, iterations, "--agent.resume", "True", *flags)
    straight = train(tmp_path / "straight", iterations, *flags)
    name = f"model_{iterations - 1}.pt"
    for model in ("actor_state_dict", "critic_state_dict"):
        one = load_checkpoint(resumed / name)[model]
        other = load_checkpoint(straight / name)[model]
        assert one.keys() == other.keys()
        assert [key for key in one if not torch.equal(one[key], other[key])] == []
    return resumed


@pytest.mark.slow
def test_a_killed_run_resumes_bit_for_bit(train, tmp_path):
    log_root = tmp_path / "logs"
    process = start_endless_run(log_root)
    wait_for_checkpoint(log_root, process, "model_1.pt")
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    (run_dir,) = (log_root / "cartpole").iterdir()
    assert_resumes_exactly(train, log_root, run_dir, tmp_path)


def test_sigterm_saves_and_exports(tmp_path):
    log_root = tmp_path / "logs"
    process = start_endless_run(log_root)
    wait_for_checkpoint(log_root, process, "model_0.pt")
    process.terminate()
    out = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 143, out
    assert "SIGTERM: finishing this iteration, then saving" in out
    assert "Interrupted at" in out
    (run_dir,) = (log_root / "cartpole").iterdir()
    info = Run(run_dir).info
    assert info["ended"] == "interrupted"
    assert [c.path for c in Run(run_dir).checkpoints][
        -1
    ].name == f"model_{info['iterations'] - 1}.pt"
    assert list(run_dir.glob("*.onnx"))


def test_a_preempted_job_gives_the_same_bits(run, tmp_path):
    """As a queue does it: SIGTERM, time to end, and the same command again."""
    job, straight = (
        [TASK, *SMALL, "--log-root", str(tmp_path / name), "--agent.max-iterations", "6"]
        + ["--agent.save-interval", "1000", "--agent.resume", "auto", "--grace", "25"]
        for name in ("job", "straight")
    )
    with stopped_after(3, signal.SIGTERM):
        assert run("train", *job).status == 143
    for command in (job, straight):
        outcome = run("train", *command)
        assert outcome.status == 0, outcome.err
    preempted, resumed = sorted((tmp_path / "job" / "cartpole").iterdir())
    assert Run(preempted).info["iterations"] < 6
    (uninterrupted,) = (tmp_path / "straight" / "cartpole").iterdir()
    for model in ("actor_state_dict", "critic_state_dict"):
        one, other = (
            load_checkpoint(folder / "model_5.pt")[model] for folder in (resumed, uninterrupted)
        )
        assert one.keys() == other.keys()
        assert all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.slow
def test_a_signalled_evaluation_is_repeated(train, tmp_path):
    log_root = tmp_path / "logs"
    flags = ("--agent.evaluation.trigger-return=-1e9", "--agent.evaluation.min-interval", "1")
    flags += ("--agent.evaluation.num-episodes", "256")
    process = start_endless_run(log_root, *flags)
    wait_for_checkpoint(log_root, process, "model_0.pt")
    process.terminate()
    out = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 143, out
    (run_dir,) = (log_root / "cartpole").iterdir()
    assert [c.path.name for c in Run(run_dir).checkpoints] == ["model_0.pt"]
    assert load_checkpoint(run_dir / "model_0.pt")["owes_evaluation"]
    flags = (*flags[:-1], "4")
    resumed = assert_resumes_exactly(train, log_root, run_dir, tmp_path, *flags)
    assert list(read_scalars(resumed, "Evaluation/mean_return")[0]) == [0, 1, 2]


@pytest.mark.slow
@pytest.mark.parametrize("flags", [("--grace", "0"), pytest.param((), marks=pytest.mark.slow)])
def test_a_long_iteration_is_given_up(tmp_path, flags):
    """By a second signal, or after the grace: what was finished before is saved."""
    log_root, steps = tmp_path / "logs", ("--agent.num-steps-per-env", "1000")
    process = start_endless_run(log_root, *steps, *flags, "--agent.save-interval", "1000")
    wait_for_checkpoint(log_root, process, "model_0.pt")
    time.sleep(1.0)
    for _ in range(1 if flags else 2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    out = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 130, out
    assert "is given up" in out
    assert "Failed" not in out
    (run_dir,) = (log_root / "cartpole").iterdir()
    info = Run(run_dir).info
    assert info["ended"] == "interrupted"
    last = Run(run_dir).newest.content
    assert last["iterations_finished"] == info["iterations"]
    assert "observations" in last["training_state"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_a_terminal_that_is_closed_leaves_a_checkpoint(tmp_path):
    import pty

    log_root = tmp_path / "logs"
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, endless_run(log_root))
    # A writer blocks if its terminal is not read.
    reader = threading.Thread(target=read_until_closed, args=(terminal,), daemon=True)
    reader.start()
    end = time.monotonic() + PATIENCE
    while not list(log_root.glob("cartpole/*/model_0.pt")) and time.monotonic() < end:
        time.sleep(0.01)
    os.kill(child, signal.SIGHUP)
    os.close(terminal)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    (run_dir,) = (log_root / "cartpole").iterdir()
    info = Run(run_dir).info
    assert (status, info["ended"]) == (129, "interrupted")
    assert Run(run_dir).newest.path.name == f"model_{info['iterations'] - 1}.pt"


def read_until_closed(terminal: int) -> None:
    with contextlib.suppress(OSError):
        while os.read(terminal, 4096):
            pass


@pytest.mark.slow
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGHUP, signal.SIGINT)),
    ],
)
def test_a_signal_while_building_leaves_no_folder(tmp_path, number):
    # Building takes as long as the signal needs; the folder is there by then.
    program = (
        "import os, signal, sys, time\n"
        "from mjlab.scripts import train\n"
        "def build(*args):\n"
        f"    os.kill(os.getpid(), {int(number)})\n"
        "    time.sleep(30)\n"
        "train.training_env = build\n"
        "train.main()\n"
    )
    flags = [TASK, *SMALL, "--log-root", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", program, *flags],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 128 + number
    assert "Traceback" not in done.stderr
    assert list((tmp_path / "cartpole").iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no signals to groups of processes")
def test_a_broken_pipe_leaves_a_checkpoint(tmp_path):
    log_root = tmp_path / "logs"
    process = subprocess.Popen(
        endless_run(log_root), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert process.stdout is not None
    end = time.monotonic() + PATIENCE
    while not list(log_root.glob("cartpole/*/model_0.pt")) and time.monotonic() < end:
        time.sleep(0.01)
    # As `train | tee log`, when Ctrl-C ends `tee`.
    process.stdout.close()
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 130
    (run_dir,) = (log_root / "cartpole").iterdir()
    info = Run(run_dir).info
    assert info["ended"] == "interrupted"
    assert [c.path for c in Run(run_dir).checkpoints][
        -1
    ].name == f"model_{info['iterations'] - 1}.pt"


# Several processes: one policy, one run folder, one fate.


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> tuple[ProcessRun, list[Ended]]:
    """Return a finished run of two processes and two iterations, and how they ended."""
    folder = tmp_path_factory.mktemp("pair")
    run = ProcessRun(folder, "--agent.max-iterations", "2")
    ended = run.end()
    assert [process.status for process in ended] == [0, 0], ended
    return run, ended


def assert_same_weights(run: ProcessRun) -> None:
    first, second = run.probe(0)["weights"], run.probe(1)["weights"]
    assert first.keys() == second.keys()
    assert [name for name in first if not torch.equal(first[name], second[name])] == []
    assert run.probe(0)["learning_rate"] == run.probe(1)["learning_rate"]


def test_both_end_with_the_same_networks_bit_for_bit(pair):
    run, _ = pair
    assert_same_weights(run)
    (run_dir,) = run.runs()
    saved = load_checkpoint(run_dir / "model_1.pt")["actor_state_dict"]
    held = run.probe(1)["weights"]
    assert [name for name in saved if not torch.equal(saved[name], held[name])] == []


def test_normalizers_see_data_of_all_processes(pair):
    run, _ = pair
    # Two iterations of four steps in four environments, in each of two processes.
    assert run.probe(0)["weights"]["obs_normalizer.count"] == 2 * 4 * 4 * 2


def test_every_process_draws_random_numbers_of_its_own(pair):
    run, _ = pair
    first, second = run.probe(0), run.probe(1)
    # Not 8 in the second process: 8 is the first seed of a run with seed 8.
    seeds = (7, process_seed(7, 1))
    assert (first["seed"], second["seed"]) == seeds
    assert (first["env_seed"], second["env_seed"]) == seeds
    assert not torch.equal(first["qpos"], second["qpos"])
    assert not torch.equal(first["draw"], second["draw"])


def test_the_first_alone_writes_files_and_prints(pair):
    run, (first, second) = pair
    (run_dir,) = run.runs()
    assert len(list(run_dir.glob("events.out.tfevents.*"))) == 1
    assert (run_dir / "params" / "agent.yaml").is_file()
    assert run.probe(0)["saved"] == ["model_0.pt", "model_1.pt"]
    assert run.probe(1)["saved"] == []
    assert f"{TASK}, 4 environments in each of 2 processes" in first.out
    assert "Finished" in first.out
    assert (second.out, second.err) == ("", "")
    assert f"Run:     {run_dir}" in (run_dir / "torchrunx" / "rank_1.log").read_text()


@pytest.mark.parametrize(("rank", "render_mode"), [(0, "rgb_array"), (1, None)])
def test_the_first_alone_renders(tmp_path, rank, render_mode):
    cfg = parse_train_flags(TASK, ["--num-envs", "2", "--video"], "train")
    env = training_env(cfg, "cpu", tmp_path, ProcessRank(rank, 2, rank, 2))
    assert env.render_mode == render_mode
    env.close()


def test_steps_are_counted_over_both(pair):
    run, _ = pair
    assert run.probe(0)["total_steps"] == 2 * 4 * 4 * 2


def test_the_cores_are_shared_out(pair):
    run, _ = pair
    share = max(1, available_cores() // 2)
    assert run.probe(0)["threads"] == run.probe(1)["threads"] == share


def test_processes_resume_from_one_checkpoint(pair):
    run, _ = pair
    (before,) = run.runs()
    # A folder without a checkpoint, as a run leaves that was killed early.
    early = before.with_name("9999-01-01_00-00-00")
    early.mkdir()
    flags = ("--agent.resume", "True", "--agent.max-iterations", "3", "--torchrunx-log-dir", "")
    drawn = ("--agent.seed", "-1")
    resumed = ProcessRun(run.folder, *flags, *drawn, patches=("count_lookups",))
    ended = resumed.end()
    early.rmdir()
    assert [process.status for process in ended] == [0, 0], ended
    # Also a process that is late does not look again, and would find the new folder.
    lookups = (run.folder / "lookups").read_text().splitlines()
    assert lookups == [f"0 {before / 'model_1.pt'} 2"]
    assert "several processes share the run" in ended[0].err
    (run_dir,) = set(resumed.runs()) - {before}
    assert [path.name for path in [c.path for c in Run(run_dir).checkpoints]] == ["model_2.pt"]
    assert not (run_dir / "torchrunx").exists()
    # The first process tells all the seed of the run that is resumed.
    seed = resumed.probe(0)["seed"]
    assert f"{seed}, as before" in ended[0].out
    assert resumed.probe(1)["seed"] == process_seed(seed, 1)
    assert resumed.probe(1)["iterations"] == 3
    assert resumed.probe(0)["total_steps"] == 3 * 4 * 4 * 2
    assert_same_weights(resumed)
    events = EventAccumulator(str(run_dir)).Reload()
    assert [event.step for event in events.Scalars("Train/mean_step_reward")] == [2]


def test_a_failing_process_ends_the_others(tmp_path):
    flags = ("--agent.max-iterations", "1000")
    run = ProcessRun(tmp_path, *flags, patches=("fail_while_training",))
    first, second = run.end()
    assert (first.status, second.status) == (3, 1)
    assert "error in process 1: the robot of process 1 fell off the table" in second.err
    assert first.err.count("error: ") == 1
    assert "Another process of this run ended" in first.err
    assert "Traceback" not in first.err
    (run_dir,) = run.runs()
    assert Run(run_dir).info["ended"] == "failed"
    assert [c.path for c in Run(run_dir).checkpoints][-1].name == "model_0.pt"


def test_a_process_failing_early_leaves_no_folder(tmp_path):
    first, second = ProcessRun(tmp_path, patches=("fail_while_building",)).end()
    assert (first.status, second.status) == (3, 1)
    assert "error in process 1: no room in process 1" in second.err
    assert "Process 1 of this run failed: ValueError: no room in process 1" in first.err
    assert list((tmp_path / "logs" / "cartpole").iterdir()) == []


@pytest.mark.slow
def test_errors_of_all_processes_are_told_once(tmp_path):
    first, second = ProcessRun(tmp_path, "--agent.save-interval", "0").end()
    assert (first.status, second.status) == (1, 3)
    assert "--agent.save-interval: expected an integer >= 1, got 0" in first.err
    assert second.err == ""


@pytest.mark.slow
def test_a_signal_to_one_process_stops_all(tmp_path):
    run = ProcessRun(tmp_path, "--agent.max-iterations", "1000000")
    end = time.monotonic() + 60
    while not list(tmp_path.glob("logs/cartpole/*/model_0.pt")) and time.monotonic() < end:
        time.sleep(0.01)
    run.send(1, signal.SIGINT)
    ended = run.end()
    assert [process.status for process in ended] == [130, 130], ended
    assert "Interrupted at" in ended[0].out
    (run_dir,) = run.runs()
    iterations = Run(run_dir).info["iterations"]
    assert run.probe(0)["iterations"] == run.probe(1)["iterations"] == iterations
    assert [c.path for c in Run(run_dir).checkpoints][-1].name == f"model_{iterations - 1}.pt"
    assert len(run.probe(0)["saved"]) == len(set(run.probe(0)["saved"]))
    assert_same_weights(run)


@pytest.mark.slow
def test_torchrun_trains_and_reports_a_failure(tmp_path):
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    torchrun += ["--master-port", "0", "--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0"]
    command = [
        *torchrun,
        "-m",
        "mjlab.scripts.train",
        TASK,
        *SMALL_PROCESS,
        "--log-root",
        str(tmp_path),
    ]
    done = subprocess.run(
        [*command, "--agent.max-iterations", "2"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Finished" in done.stdout
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    assert len(list(run_dir.glob("events.out.tfevents.*"))) == 1
    assert [path.name for path in [c.path for c in Run(run_dir).checkpoints]] == [
        "model_0.pt",
        "model_1.pt",
    ]
    resumed = subprocess.run(
        [*command, "--agent.max-iterations", "3", "--agent.resume", "True"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert resumed.returncode == 0, resumed.stderr
    assert f"Resumed: {run_dir / 'model_1.pt'}, iteration 2" in resumed.stdout
    failed = subprocess.run(
        [*command, "--agent.save-interval", "0"], capture_output=True, text=True, check=False
    )
    assert failed.returncode != 0
    assert "--agent.save-interval: expected an integer >= 1, got 0" in failed.stderr


@pytest.mark.slow
def test_the_launcher_trains_and_ctrl_c_saves_once(tmp_path):
    program = (
        "import sys\nfrom mjlab.rl.distributed import launch_workers\n"
        "from mjlab.cli.main import run_command\n"
        "command = [sys.executable, '-m', 'mjlab.scripts.train']\n"
        "run_command(lambda argv: launch_workers(command + argv, 2))\n"
    )
    flags = [TASK, *SMALL_PROCESS, "--log-root", str(tmp_path), "--agent.max-iterations", "1000000"]
    interrupt_training([sys.executable, "-c", program, *flags], tmp_path, patience=120.0)


@pytest.mark.slow
def test_workers_of_a_killed_launcher_save_and_end(tmp_path):
    program = (
        "import sys\nfrom mjlab.rl.distributed import launch_workers\n"
        "command = [sys.executable, '-m', 'mjlab.scripts.train']\n"
        "launch_workers(command + sys.argv[1:], 2)\n"
    )
    flags = [TASK, *SMALL_PROCESS, "--log-root", str(tmp_path), "--agent.max-iterations", "1000000"]
    launcher = subprocess.Popen([sys.executable, "-c", program, *flags])
    end = time.monotonic() + 120.0
    while not list(tmp_path.glob("cartpole/*/model_0.pt")) and time.monotonic() < end:
        time.sleep(0.02)
    launcher.kill()
    launcher.wait()
    (run_dir,) = (tmp_path / "cartpole").iterdir()
    while "ended" not in Run(run_dir).info and time.monotonic() < end:
        time.sleep(0.02)
    info = Run(run_dir).info
    assert info["ended"] == "interrupted"
    assert [c.path for c in Run(run_dir).checkpoints][
        -1
    ].name == f"model_{info['iterations'] - 1}.pt"
