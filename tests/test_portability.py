"""Other platforms, simulated: training works without the names that Windows and macOS lack."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjlab.utils import signals

# Windows lacks these names; macOS lacks the last two.
_WITHOUT = """
import os, signal, sys
import numpy, torch  # Libraries choose by sys.platform, which stays as it is.
for name in ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGQUIT"):
    delattr(signal, name)
for name in ("geteuid", "nice", "symlink", "sched_getaffinity", "sched_setaffinity"):
    delattr(os, name)
sys.modules["fcntl"] = None
from mjlab.scripts.cli import run_command
from mjlab.scripts.{module} import command
run_command(lambda argv: command(argv, "{module}"))
"""


def _run(module: str, *flags: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _WITHOUT.format(module=module), *flags],
        capture_output=True,
        text=True,
        check=False,
    )


def test_training_works_without_names_of_linux(tmp_path: Path) -> None:
    task = ("Mjlab-Cartpole-Balance", "--device", "cpu", "--log-root", str(tmp_path))
    sizes = ("--num-envs", "4", "--agent.max-iterations", "1", "--agent.num-steps-per-env", "4")
    trained = _run("train", *task, *sizes)
    assert trained.returncode == 0, trained.stderr
    assert list(tmp_path.glob("*/*/model_0.pt"))


def test_on_windows_training_gets_ctrl_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C does not reach processes of another group there, and `Popen` accepts no SIGINT."""
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(signal, "CTRL_BREAK_EVENT", 1, raising=False)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0x200, raising=False)
    started: dict[str, Any] = {}
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: started.update(options))
    signals.start_in_background(["train"], {})
    assert started["creationflags"] == 0x200
    sent: list[int] = []
    process: Any = SimpleNamespace(send_signal=sent.append)
    signals.send_signal(process, signal.SIGINT)
    signals.send_signal(process, signal.SIGTERM)
    assert sent == [1, 1]
