"""Iterations until the swing-up is solved, and seconds from the start of the command."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import solving
from report import Row, show
from solving import Solved

TASK = "Mjlab-Cartpole-Swingup"
SEEDS = (1, 2, 3, 4, 5)
EPISODES = 256
RETURN = 900


def train(seed: int, log_root: str) -> Solved:
    """Run `train` until it stops by itself; return when that was, and the policy's score."""
    run = solving.train(TASK, ["--num-envs", "512"], seed, log_root, EPISODES)
    if run is None:
        raise RuntimeError(f"Seed {seed} was not solved.")
    return run


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
    returns = [run.score["mean_return"] for run in runs]
    return [
        Row(
            f"swing-up, 512 envs, seeds {SEEDS[0]} to {SEEDS[-1]}: iterations until the mean "
            f"return passes {RETURN} in two samples of {EPISODES} episodes",
            ", ".join(map(str, iterations)),
            f"returns then, by `evaluate` on {EPISODES} other episodes: "
            + ", ".join(f"{value:.0f}" for value in returns),
            "at most 60 on each",
            max(iterations) <= 60 and min(returns) > RETURN,
        ),
        Row(
            "time from `train` on the command line to that point, evaluations included",
            ", ".join(f"{value:.1f} s" for value in seconds),
            "bare loop (mujoco.batch and rsl_rl), as many iterations, without evaluation: "
            + ", ".join(f"{value:.1f} s" for value in bare),
            "under 20 s",
            max(seconds) < 20,
        ),
    ]


if __name__ == "__main__":
    print(show(measure()))
