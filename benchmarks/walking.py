"""Time until Go1 walks, on two cores with the task's `cpu` profile, next to a bare loop.

`uv run --group dev python benchmarks/walking.py [SEED ...]` trains the given seeds (default: 1 to 3),
and the bare loop of `bare_go1.py` with the first. Evaluations stop training, and `evaluate` then scores the
policy on other episodes, of the task without the profile. Tracking is
reached if in these 400 episodes the mean error of linear velocity is under 0.25 m/s, of angular velocity
under 0.35 rad/s, and under 5 % of them ended in a fall.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import solving
from commands import output_of
from report import Row, show
from solving import Solved

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
SEEDS = (1, 2, 3)
EPISODES = 400
LIMIT_MINUTES = 8
BOUNDS = {"lin_vel_error": 0.25, "ang_vel_error": 0.35}
MOST_FALLS = 0.05


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
            log_root = str(Path(folder) / str(seed))
            runs.append(solving.train(TASK, ["--profile", "cpu"], seed, log_root, EPISODES))
            print(runs[-1], flush=True)
    return [
        Row(
            "Go1 flat, `--profile cpu`, two cores, seeds "
            f"{', '.join(map(str, seeds))}: time from `train` until it stops because it tracks the velocity command",
            "; ".join(_shown(run) for run in runs),
            "bare loop (mujoco.batch and rsl_rl, rewards by hand, same PPO settings without mirror images, "
            f"at most {LIMIT_MINUTES} min): {_shown_bare(beside)}",
            f"under {LIMIT_MINUTES} min",
            all(
                run is not None and run.seconds < 60 * LIMIT_MINUTES and _tracks(run.score)
                for run in runs
            ),
        )
    ]


def _tracks(score: dict[str, Any]) -> bool:
    errors = score["metrics"]
    within = all(errors[name]["mean"] < most for name, most in BOUNDS.items())
    return within and score["failure_rate"] < MOST_FALLS


def _shown(run: Solved | None) -> str:
    if run is None:
        return "not reached"
    errors = ", ".join(f"{name} {run.score['metrics'][name]['mean']:.2f}" for name in BOUNDS)
    low, high = run.score["failure_interval"]
    return (
        f"{run.seconds / 60:.1f} min ({run.iterations} iterations; `evaluate` on {EPISODES} other "
        f"episodes: {errors}, {run.score['failure_rate']:.1%} falls [{low:.1%}, {high:.1%}])"
    )


def _shown_bare(metrics: dict[str, float] | None) -> str:
    if metrics is None:
        return "no evaluation"
    errors = (
        f"{metrics['linear']:.2f} m/s, {metrics['angular']:.2f} rad/s, {metrics['falls']:.0%} falls"
    )
    return f"{metrics['seconds'] / 60:.1f} min ({metrics['iterations']} iterations; {errors})"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", nargs="*", type=int, default=list(SEEDS), help="seeds to train")
    print(show(measure(tuple(parser.parse_args().seeds))))
