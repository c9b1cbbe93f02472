"""Training in other processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from types import FrameType

from mjlab.utils.processes import PARENT_VARIABLE
from mjlab.utils.signals import FORWARDED, handled_signals, send_signal, start_in_background


def train_command(task: str, flags: list[str], seed: int) -> list[str]:
    """Return the command that trains `task` with `seed` in another process."""
    command = [sys.executable, "-m", "mjlab.scripts.train", task]
    return [*command, *flags, "--agent.seed", str(seed)]


def run_forwarding_signals(
    command: list[str], seconds: float | None = None
) -> tuple[int, signal.Signals | None]:
    """Run `command`; return its exit status, and the first stop signal that this process received.

    SIGINT, SIGTERM and SIGHUP do not end this process: each is forwarded to `command` once, and this
    process waits until `command` has ended, e.g. saved. After `seconds`, `command` receives SIGINT.
    """
    child: subprocess.Popen[bytes] | None = None
    received: list[signal.Signals] = []

    def forward(number: int, frame: FrameType | None = None) -> None:
        received.append(signal.Signals(number))
        if child is not None:
            send_signal(child, FORWARDED[number])

    with handled_signals(forward, FORWARDED):
        # A terminal sends Ctrl-C to all of its processes, and a second signal would give up the
        # running iteration.
        child = start_in_background(command, {**os.environ, PARENT_VARIABLE: str(os.getpid())})
        for number in tuple(received):
            send_signal(child, FORWARDED[number])
        try:
            status = child.wait(seconds)
        except subprocess.TimeoutExpired:
            if not received:
                send_signal(child, signal.SIGINT)
            status = child.wait()
    return status, received[0] if received else None
