"""Commands run within the test process."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from mjlab.cli import display
from mjlab.rl.run_logger import IterationStats
from mjlab.runs import Run

TASK = "Mjlab-Cartpole-Swingup"
SMALL = [
    "--num-envs", "16", "--device", "cpu", "--agent.num-steps-per-env", "8", "--agent.seed", "7",
    "--agent.save-interval", "1",
]  # fmt: skip


@dataclass
class Outcome:
    """How a command ended."""

    status: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """The one error message of a command that failed."""
        lines = [line for line in self.err.splitlines() if line.startswith("error: ")]
        assert len(lines) == 1, self.err
        return self.err[self.err.index("error: ") :]


@contextlib.contextmanager
def _kept_process_settings() -> Iterator[None]:
    """Put back what a command sets for its process: logging, warnings and torch's threads."""
    root, package = logging.getLogger(), logging.getLogger("mjlab")
    handlers, levels = list(root.handlers), (root.level, package.level)
    form, threads = warnings.formatwarning, torch.get_num_threads()
    try:
        yield
    finally:
        logging.captureWarnings(False)
        root.handlers[:] = handlers
        root.setLevel(levels[0])
        package.setLevel(levels[1])
        warnings.formatwarning = form
        torch.set_num_threads(threads)


def run_script(script: str, *argv: str) -> Outcome:
    """Run `script` (a module of mjlab.scripts) with `argv`, as the command line does."""
    return run_main(importlib.import_module(f"mjlab.scripts.{script}").main, script, *argv)


def run_main(main: Callable[[], None], name: str, *argv: str) -> Outcome:
    """Call the entry point `main` as the command `name` with `argv`."""
    out, err = io.StringIO(), io.StringIO()
    before, status = sys.argv, 0
    sys.argv = [name, *argv]
    try:
        with (
            _kept_process_settings(),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            # Otherwise messages would go to the handlers of the test runner.
            logging.getLogger().handlers.clear()
            main()
    except SystemExit as ended:
        status = ended.code
    finally:
        sys.argv = before
    assert isinstance(status, int)
    return Outcome(status, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def stopped_after(iterations: int, number: int = signal.SIGINT) -> Iterator[None]:
    """Send a signal to this process when a training run in it has had so many iterations."""

    def stop(observer: object, stats: IterationStats) -> None:
        if stats.iteration == iterations:
            signal.raise_signal(number)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(display.RunRecorder, "on_iteration", stop)
        yield


def interrupt_training(command: list[str], log_root: Path, patience: float = 60.0) -> str:
    """Press Ctrl-C once a training run in `log_root` has a checkpoint; return what was printed.

    Checks that the run was interrupted and saved once, with what it had learned by then. `patience`
    is in seconds.
    """
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, process_group=0
    )
    end = time.monotonic() + patience
    while not list(log_root.glob("cartpole/*/model_0.pt")) and time.monotonic() < end:
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.02)
    # As a terminal does it: to the whole process group.
    os.killpg(process.pid, signal.SIGINT)
    try:
        out = process.communicate(timeout=patience)[0]
    except subprocess.TimeoutExpired:
        # A run that ignores the signal must not outlive the test.
        os.killpg(process.pid, signal.SIGTERM)
        raise
    assert process.returncode == 130, out
    assert out.count("SIGINT: finishing this iteration, then saving") == 1
    (run_dir,) = (log_root / "cartpole").iterdir()
    info = Run(run_dir).info
    assert info["ended"] == "interrupted"
    assert [c.path for c in Run(run_dir).checkpoints][
        -1
    ].name == f"model_{info['iterations'] - 1}.pt"
    return out
