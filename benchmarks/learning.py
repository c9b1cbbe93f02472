"""Time until the swing-up is solved and until Go1 walks, on two cores, next to bare loops.

`uv run --group dev python benchmarks/learning.py [cartpole|go1] [SEED ...]` trains both or one, with the given seeds
(default: 1 to 5 and 1 to 3). Evaluations stop training, and `evaluate` then scores the policy on a seed not used in
training: the evaluation that stopped a run is biased upwards, because a worse one would not have stopped it. Go1 trains
with the task's `cpu` profile and is scored without it. Tracking is reached if in 400 episodes the mean error of linear
velocity is under 0.25 m/s, of angular velocity under 0.35 rad/s, and under 5 % of them ended in a fall.
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
from typing import Any

from measure import Row, output_of, show

EVALUATION_SEED = 1000
_BARE = str(Path(__file__).parent / "bare.py")
_SOLVED = re.compile(r"Evaluation after (\d+) iterations: .*, solved\.")

CARTPOLE = "Mjlab-Cartpole-Swingup"
CARTPOLE_SEEDS = (1, 2, 3, 4, 5)
CARTPOLE_EPISODES = 256
CARTPOLE_RETURN = 900

GO1 = "Mjlab-Velocity-Flat-Unitree-Go1"
GO1_SEEDS = (1, 2, 3)
GO1_EPISODES = 400
GO1_MINUTES = 8
GO1_BOUNDS = {"lin_vel_error": 0.25, "ang_vel_error": 0.35}
GO1_FALLS = 0.05


def measure() -> list[Row]:
    """Measure both tasks."""
    return [*measure_cartpole(), *measure_go1()]


def measure_cartpole(seeds: tuple[int, ...] = CARTPOLE_SEEDS) -> list[Row]:
    """Train every seed, each followed by the bare loop for as many iterations."""
    runs, bare = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            log_root = str(Path(folder) / str(seed))
            run = train(CARTPOLE, ["--num-envs", "512"], seed, log_root, CARTPOLE_EPISODES)
            if run is None:
                raise RuntimeError(f"Seed {seed} was not solved.")
            runs.append(run)
            begin = time.perf_counter()
            output_of([sys.executable, _BARE, "cartpole", str(run.iterations), str(seed)])
            bare.append(time.perf_counter() - begin)
            print(runs[-1], f"bare loop {bare[-1]:.1f} s", flush=True)
    iterations = [run.iterations for run in runs]
    seconds = [run.seconds for run in runs]
    returns = [run.score["mean_return"] for run in runs]
    return [
        Row(
            f"swing-up, 512 envs, seeds {seeds[0]} to {seeds[-1]}: iterations until the mean "
            f"return passes {CARTPOLE_RETURN} in two samples of {CARTPOLE_EPISODES} episodes",
            ", ".join(map(str, iterations)),
            f"returns then, by `evaluate` on {CARTPOLE_EPISODES} other episodes: "
            + ", ".join(f"{value:.0f}" for value in returns),
            "at most 60 on each",
            max(iterations) <= 60 and min(returns) > CARTPOLE_RETURN,
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


def measure_go1(seeds: tuple[int, ...] = GO1_SEEDS) -> list[Row]:
    """Train each seed, and the bare loop with the first."""
    printed = output_of([sys.executable, _BARE, "go1", str(GO1_MINUTES), str(seeds[0])])
    lines = [line for line in printed.splitlines() if line.startswith('{"seconds"')]
    beside = json.loads(lines[-1]) if lines else None
    runs: list[Solved | None] = []
    print(beside, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            log_root = str(Path(folder) / str(seed))
            runs.append(train(GO1, ["--profile", "cpu"], seed, log_root, GO1_EPISODES))
            print(runs[-1], flush=True)
    return [
        Row(
            "Go1 flat, `--profile cpu`, two cores, seeds "
            f"{', '.join(map(str, seeds))}: time from `train` until it stops because it tracks the velocity command",
            "; ".join(_shown(run) for run in runs),
            "bare loop (mujoco.batch and rsl_rl, rewards by hand, same PPO settings without mirror images, "
            f"at most {GO1_MINUTES} min): {_shown_bare(beside)}",
            f"under {GO1_MINUTES} min",
            all(
                run is not None and run.seconds < 60 * GO1_MINUTES and _tracks(run.score)
                for run in runs
            ),
        )
    ]


def _tracks(score: dict[str, Any]) -> bool:
    errors = score["metrics"]
    within = all(errors[name]["mean"] < most for name, most in GO1_BOUNDS.items())
    return within and score["failure_rate"] < GO1_FALLS


def _shown(run: Solved | None) -> str:
    if run is None:
        return "not reached"
    errors = ", ".join(f"{name} {run.score['metrics'][name]['mean']:.2f}" for name in GO1_BOUNDS)
    low, high = run.score["failure_interval"]
    return (
        f"{run.seconds / 60:.1f} min ({run.iterations} iterations; `evaluate` on {GO1_EPISODES} other "
        f"episodes: {errors}, {run.score['failure_rate']:.1%} falls [{low:.1%}, {high:.1%}])"
    )


def _shown_bare(metrics: dict[str, float] | None) -> str:
    if metrics is None:
        return "no evaluation"
    errors = (
        f"{metrics['linear']:.2f} m/s, {metrics['angular']:.2f} rad/s, {metrics['falls']:.0%} falls"
    )
    return f"{metrics['seconds'] / 60:.1f} min ({metrics['iterations']} iterations; {errors})"


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
    command = [sys.executable, "-m", "mjlab.cli.main", "train", task, *flags, "--device", "cpu"]
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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", nargs="?", choices=("cartpole", "go1"), help="default: both")
    parser.add_argument("seeds", nargs="*", type=int, help="seeds to train")
    args = parser.parse_args()
    seeds = (tuple(args.seeds),) if args.seeds else ()
    measures = {"cartpole": measure_cartpole, "go1": measure_go1}
    print(show(measures[args.task](*seeds) if args.task else measure()))
