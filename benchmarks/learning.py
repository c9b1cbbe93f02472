"""How fast the swing-up is solved: iterations, and seconds from the command line on."""

from __future__ import annotations

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

TASK = "Mjlab-Cartpole-Swingup"
SEEDS = (1, 2, 3, 4, 5)
EPISODES = 256
_SOLVED = re.compile(r"Evaluation after (\d+) iterations: mean return ([\d.]+).*, solved")


@dataclass(frozen=True)
class Solved:
    """When a run was solved."""

    seed: int
    iterations: int
    seconds: float
    mean_return: float
    confirmed: float


def train(seed: int, log_root: str) -> Solved:
    """Run `train` until it stops by itself; return when it said that the task is solved."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "mjlab.scripts.train", TASK, "--num-envs", "512"]
    command += ["--device", "cpu", "--agent.seed", str(seed), "--log-root", log_root]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    iterations, mean_return, seconds, output = 0, 0.0, float("nan"), []
    assert process.stdout is not None
    for line in process.stdout:
        output.append(line)
        match = _SOLVED.search(line)
        if match:
            seconds = time.perf_counter() - begin
            iterations, mean_return = int(match.group(1)), float(match.group(2))
    if process.wait() != 0 or iterations == 0:
        raise RuntimeError(f"Seed {seed} was not solved:\n{''.join(output[-20:])}")
    return Solved(seed, iterations, seconds, mean_return, _confirm(log_root))


def _confirm(log_root: str) -> float:
    """Return the mean return of the newest policy, scored by `evaluate` on a seed of its own."""
    command = [sys.executable, "-m", "mjlab.scripts.evaluate", TASK, "--log-root", log_root]
    command += ["--num-episodes", str(EPISODES), "--json", "True", "--device", "cpu"]
    printed = output_of(command)
    return float(json.loads(printed[printed.index("{") :])["mean_return"])


def bare_loop(iterations: int, seed: int) -> float:
    """Return the seconds that the bare loop takes for as many iterations, start-up included."""
    begin = time.perf_counter()
    script = Path(__file__).parent / "bare_loop.py"
    subprocess.run(
        [sys.executable, str(script), str(iterations), str(seed)], capture_output=True, check=True
    )
    return time.perf_counter() - begin


def measure() -> list[Row]:
    """Train every seed, each followed by the bare loop for as many iterations."""
    runs, bare = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in SEEDS:
            runs.append(train(seed, str(Path(folder) / str(seed))))
            bare.append(bare_loop(runs[-1].iterations, seed))
            print(runs[-1], f"bare loop {bare[-1]:.1f} s", flush=True)
    iterations = [run.iterations for run in runs]
    seconds = [run.seconds for run in runs]
    returns = ", ".join(f"{run.confirmed:.0f}" for run in runs)
    return [
        Row(
            f"swing-up, 512 envs, seeds {SEEDS[0]} to {SEEDS[-1]}: iterations until the mean "
            f"return over {EPISODES} episodes passes 900",
            ", ".join(map(str, iterations)),
            f"returns then, scored anew by `evaluate`: {returns}",
            "at most 60 on each",
            max(iterations) <= 60 and all(run.confirmed > 900 for run in runs),
        ),
        Row(
            "time from `train` on the command line to that point, evaluation included",
            ", ".join(f"{value:.1f} s" for value in seconds),
            "bare loop (mjbatch and rsl_rl), as many iterations, without evaluation: "
            + ", ".join(f"{value:.1f} s" for value in bare),
            "under 20 s",
            max(seconds) < 20,
        ),
    ]


if __name__ == "__main__":
    print(show(measure()))
