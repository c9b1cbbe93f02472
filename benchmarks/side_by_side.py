"""Speed of `env.step` over that of another checkout, such as of the commit before.

git worktree add ../before COMMIT && (cd ../before && ./tools/uv sync)
python benchmarks/side_by_side.py ../before
"""

from __future__ import annotations

import argparse
from pathlib import Path

from measure import Row, show
from stepping import HERE, NUM_THREADS, Stepper, median_times

CASES = (
    ("Mjlab-Cartpole-Swingup", "cartpole", 4096),
    ("Mjlab-Velocity-Flat-Unitree-Go1", "Go1 flat", 1024),
    ("Mjlab-Velocity-Flat-Unitree-G1", "G1 flat", 1024),
    ("Mjlab-Velocity-Rough-Unitree-Go1", "Go1 rough with its height scan", 1024),
    ("Mjlab-Lift-Cube-Yam", "Lift cube from state", 1024),
    ("Mjlab-Tracking-Flat-Unitree-G1", "G1 tracking", 512),
)


def measure(other: Path, keyword: str = "") -> list[Row]:
    """Measure every task whose name contains `keyword`."""
    rows = []
    for task, name, num_envs in CASES:
        if keyword not in task:
            continue
        steppers = [Stepper(task, num_envs), Stepper(task, num_envs, other)]
        here, there = median_times(steppers, samples=5 * num_envs)
        for stepper in steppers:
            stepper.close()
        rows.append(
            Row(
                f"{name}, {num_envs} envs, native, {NUM_THREADS} threads: `env.step` over that of "
                "the other checkout",
                f"{there / here:.2f} ({num_envs / here:,.0f} env-steps/s)",
                f"the other: {num_envs / there:,.0f} env-steps/s",
                "",
                None,
            )
        )
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("other", type=Path, help="folder of the other checkout, with its own .venv")
    parser.add_argument("keyword", nargs="?", default="", help="part of a task's name")
    arguments = parser.parse_args()
    assert arguments.other.resolve() != HERE, "The other checkout is this one."
    print(show(measure(arguments.other.resolve(), arguments.keyword)))
