"""Runs trained until a task is solved, and scores of the policies on unused seeds.

The evaluation that stopped a run is biased upwards, because a worse one would not have
stopped it. So published values are those of `evaluate`, on seeds not used in training.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

from commands import output_of

EVALUATION_SEED = 1000
_SOLVED = re.compile(r"Evaluation after (\d+) iterations: .*, solved\.")


@dataclass(frozen=True)
class Solved:
    """A run that was solved, and its policy's score."""

    seed: int
    iterations: int
    seconds: float
    """Time from the command until training was told to stop."""
    score: dict[str, Any]
    """Output of `evaluate --json True` for the last checkpoint."""


def train(task: str, flags: list[str], seed: int, log_root: str, episodes: int) -> Solved | None:
    """Run `train` until it stops by itself, then `evaluate`; None if the task was not solved.

    Raises:
        RuntimeError: a command failed.
    """
    begin = time.perf_counter()
    command = [sys.executable, "-m", "mjlab.scripts.train", task, *flags, "--device", "cpu"]
    command += ["--agent.seed", str(seed), "--log-root", log_root]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    iterations, seconds, output = None, 0.0, []
    assert process.stdout is not None
    for line in process.stdout:
        output.append(line)
        match = _SOLVED.search(line)
        if match:
            seconds, iterations = time.perf_counter() - begin, int(match.group(1))
    if process.wait() != 0:
        raise RuntimeError(f"Seed {seed} failed:\n{''.join(output[-20:])}")
    if iterations is None:
        return None
    return Solved(seed, iterations, seconds, _score(task, log_root, episodes))


def _score(task: str, log_root: str, episodes: int) -> dict[str, Any]:
    """Return what `evaluate` says of the newest policy, under the profile that it was trained with."""
    command = [sys.executable, "-m", "mjlab.scripts.evaluate", task, "--log-root", log_root]
    command += ["--num-episodes", str(episodes), "--seed", str(EVALUATION_SEED)]
    printed = output_of([*command, "--json", "True", "--device", "cpu"])
    return json.loads(printed[printed.index("{") :])
