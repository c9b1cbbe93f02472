"""Other platforms, simulated: training works without the names that Windows and macOS lack."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

from mjlab.utils import signals
from mjlab.utils.wrappers import video_recorder

# Windows lacks these names; macOS lacks the last two.
_WITHOUT = """
import os, signal, sys
import numpy, torch  # Libraries choose by sys.platform, which stays as it is.
for name in ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGQUIT"):
    delattr(signal, name)
for name in ("geteuid", "nice", "symlink", "sched_getaffinity", "sched_setaffinity"):
    delattr(os, name)
sys.modules["fcntl"] = None
from mjlab.cli.main import run_command
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
    sent: list[int] = []
    process: Any = SimpleNamespace(send_signal=sent.append)
    signals.send_signal(process, signal.SIGINT)
    signals.send_signal(process, signal.SIGTERM)
    assert sent == [1, 1]


def test_on_windows_training_and_encoders_get_a_group(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Elsewhere they get a session. In either, Ctrl-C in the terminal does not reach them."""
    started: list[dict[str, Any]] = []

    class Process:
        stdin = io.BytesIO()
        returncode = 0

        def __init__(self, command: list[str], **options: Any) -> None:
            started.append(options)

        def wait(self, timeout: float | None = None) -> int:
            return 0

    for module in (signals, video_recorder):
        monkeypatch.setattr(module, "NEW_GROUP", 0x200)
    imageio_ffmpeg.get_ffmpeg_exe()  # Runs ffmpeg, once.
    monkeypatch.setattr(subprocess, "Popen", Process)
    signals.start_in_background(["train"], {})
    clip = video_recorder.ClipWriter(tmp_path / "clip.mp4", fps=30.0)
    clip.add(np.zeros((4, 4, 3), dtype=np.uint8))
    clip.close()
    assert [options["creationflags"] for options in started] == [0x200, 0x200]
    assert all(options["start_new_session"] for options in started)
