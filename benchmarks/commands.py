"""Measured commands, run in separate processes."""

from __future__ import annotations

import subprocess


def output_of(command: list[str]) -> str:
    """Run a command; return what it prints.

    Raises:
        RuntimeError: it failed; the message ends with what it said of that.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return done.stdout
