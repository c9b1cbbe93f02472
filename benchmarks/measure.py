"""Rows of the benchmark table, timers of alternating functions, and commands in separate processes."""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from mjlab.utils.processes import available_cores, processor

RESULTS = Path(__file__).parent / "results"
Sample = Callable[[], Any]


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    """Measured quantity."""
    measured: str
    """Measured value."""
    compared_with: str
    """Comparison, measured in the same run, with its value."""
    to_reach: str
    """Target."""
    reached: bool | None
    """True if the target was reached. None: no target."""


def show(rows: list[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = [
        "| what | measured | compared with | to reach | reached |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        verdict = {True: "yes", False: "**no**", None: ""}[row.reached]
        cells = (row.what, row.measured, row.compared_with, row.to_reach, verdict)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write(rows: list[Row]) -> None:
    """Write the table, with the machine it was measured on, as Markdown and JSON."""
    import mujoco
    import torch

    machine = {
        "date": datetime.now().strftime("%Y-%m-%d %H:%M"),
        "cores": available_cores(),
        "processor": processor(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mujoco": mujoco.__version__,
        "load_average": round(os.getloadavg()[0], 2),
    }
    RESULTS.mkdir(exist_ok=True)
    about = ", ".join(f"{name} {value}" for name, value in machine.items())
    (RESULTS / "table.md").write_text(f"{show(rows)}\n\nMeasured: {about}.\n", encoding="utf-8")
    content = {"machine": machine, "rows": [asdict(row) for row in rows]}
    (RESULTS / "table.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def alternate(
    *samples: Sample,
    steps: int = 20,
    repeats: int = 15,
    warm_up: int = 5,
    before: Sample = lambda: None,
    wait: Sample = lambda: None,
) -> list[float]:
    """Return the median time of each sample, in seconds, taking turns so that noise hits all.

    `before` is called before each round of samples, and not timed. `wait` returns when a device has
    done what samples have queued on it.
    """
    for sample in samples:
        for _ in range(warm_up):
            sample()
    times: list[list[float]] = [[] for _ in samples]
    turns = list(zip(samples, times, strict=True))
    for _ in range(repeats):
        before()
        # Reverse the order: the caches favor one position.
        turns.reverse()
        for sample, taken in turns:
            wait()
            begin = time.perf_counter()
            for _ in range(steps):
                sample()
            wait()
            taken.append((time.perf_counter() - begin) / steps)
    return [statistics.median(taken) for taken in times]


def output_of(command: list[str]) -> str:
    """Run a command; return what it prints.

    Raises:
        RuntimeError: it failed; the message ends with what it said of that.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return done.stdout
