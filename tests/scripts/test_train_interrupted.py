"""Runs that are ended from outside: what is on the disk then resumes as if nothing had happened."""

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
from commands import SMALL, TASK

from mjlab.rl.checkpoint import load_checkpoint
from mjlab.rl.plot import read_scalars
from mjlab.runs import Run

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


def test_a_run_that_is_killed_resumes_from_its_last_checkpoint_bit_for_bit(train, tmp_path):
    log_root = tmp_path / "logs"
    process = start_endless_run(log_root)
    wait_for_checkpoint(log_root, process, "model_1.pt")
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    (run_dir,) = (log_root / "cartpole").iterdir()
    assert_resumes_exactly(train, log_root, run_dir, tmp_path)


def test_sigterm_saves_exports_and_ends_with_its_status(train, tmp_path):
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
    assert_resumes_exactly(train, log_root, run_dir, tmp_path)


def test_an_evaluation_ends_at_a_signal_and_is_made_up_for(train, tmp_path):
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
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


@pytest.mark.skipif(sys.platform == "win32", reason="no signals to groups of processes")
def test_a_signal_that_ends_the_reader_of_a_pipe_first_leaves_a_checkpoint(tmp_path):
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
