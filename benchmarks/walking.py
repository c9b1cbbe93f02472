"""How fast Go1 learns to walk on two cores, with the task's `cpu` profile, beside a bare loop.

`uv run --group dev python benchmarks/walking.py [SEED ...]` trains seeds 1 to 3 unless told otherwise,
and the bare loop of `bare_go1.py` with the first. Tracking is reached when the evaluation that training
makes says so: over 200 episodes of the task as it is without the profile, the mean error of linear
velocity is under 0.25 m/s, of angular velocity under 0.35 rad/s, and under 5 % of the episodes ended in
a fall.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from commands import output_of
from report import Row, show

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
SEEDS = (1, 2, 3)
LIMIT_MINUTES = 8
_SOLVED = re.compile(r"Evaluation after (\d+) iterations: (.*), solved")


@dataclass(frozen=True)
class Walked:
    """When a run tracked its command."""

    seed: int
    iterations: int
    seconds: float
    figures: str


def train(seed: int, log_root: str) -> Walked | None:
    """Run `train --profile cpu`; return when it was solved, or None if it was not."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "mjlab.scripts.train", TASK, "--profile", "cpu"]
    command += ["--device", "cpu", "--agent.seed", str(seed), "--log-root", log_root]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    walked, output = None, []
    assert process.stdout is not None
    for line in process.stdout:
        output.append(line)
        match = _SOLVED.search(line)
        if match:
            seconds = time.perf_counter() - begin
            walked = Walked(seed, int(match.group(1)), seconds, match.group(2))
    if process.wait() != 0:
        raise RuntimeError(f"Seed {seed} failed:\n{''.join(output[-20:])}")
    return walked


def bare(seed: int, minutes: float) -> dict[str, float] | None:
    """Return the last evaluation of the bare loop, or None if it did not come to one."""
    script = Path(__file__).parent / "bare_go1.py"
    command = [sys.executable, str(script), str(minutes), str(seed)]
    lines = [line for line in output_of(command).splitlines() if line.startswith('{"seconds"')]
    return json.loads(lines[-1]) if lines else None


def measure(seeds: tuple[int, ...] = SEEDS) -> list[Row]:
    """Train each seed, and the bare loop with the first."""
    beside, runs = bare(seeds[0], LIMIT_MINUTES), []
    print(beside, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            runs.append(train(seed, str(Path(folder) / str(seed))))
            print(runs[-1], flush=True)
    return [
        Row(
            "Go1 flat, `--profile cpu`, two cores, seeds "
            f"{', '.join(map(str, seeds))}: time from `train` until it tracks the velocity command",
            "; ".join(_shown(run) for run in runs),
            "bare loop (mjbatch and rsl_rl, rewards by hand, same PPO settings without mirror images, "
            f"at most {LIMIT_MINUTES} min): {_shown_bare(beside)}",
            f"under {LIMIT_MINUTES} min",
            all(run is not None and run.seconds < 60 * LIMIT_MINUTES for run in runs),
        )
    ]


def _shown(run: Walked | None) -> str:
    if run is None:
        return "not reached"
    return f"{run.seconds / 60:.1f} min ({run.iterations} iterations; {run.figures})"


def _shown_bare(figures: dict[str, float] | None) -> str:
    if figures is None:
        return "no evaluation"
    errors = (
        f"{figures['linear']:.2f} m/s, {figures['angular']:.2f} rad/s, {figures['falls']:.0%} falls"
    )
    return f"{figures['seconds'] / 60:.1f} min ({figures['iterations']} iterations; {errors})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=list(SEEDS), help="seeds to train")
    print(show(measure(tuple(parser.parse_args().seeds))))
