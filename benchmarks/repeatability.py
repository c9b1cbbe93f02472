"""Bitwise repeatability of training: other thread counts, and resume after a kill.

`--families` kills and resumes a short run of every task family with PPO and SAC, without its flags.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from measure import Row, show

TASK = "Mjlab-Cartpole-Swingup"
ITERATIONS = 10
FAMILIES = (
    "Mjlab-Cartpole-Swingup",
    "Mjlab-Velocity-Flat-Unitree-Go1",
    "Mjlab-Velocity-Rough-Unitree-Go1",
    "Mjlab-Velocity-Flat-Unitree-G1",
    "Mjlab-Lift-Cube-Yam",
    "Mjlab-Tracking-Flat-Unitree-G1",
)
# Flags of a new run. A resume has them from its record.
FLAGS = (
    "--num-envs", "512", "--agent.seed", "7", "--agent.max-iterations", str(ITERATIONS),
)  # fmt: skip
OF_FAMILIES = (
    "--num-envs", "24", "--agent.seed", "7", "--agent.max-iterations", str(ITERATIONS),
    "--agent.num-steps-per-env", "6", "--env.decimation", "3", "--agent.algorithm.gamma", "0.9",
)  # fmt: skip


def _command(log_root: Path, task: str, *flags: str) -> list[str]:
    command = [sys.executable, "-m", "mjlab.scripts.train", task]
    return [*command, "--device", "cpu", "--log-root", str(log_root), *flags]


def train(log_root: Path, *flags: str, task: str = TASK) -> Path:
    """Train to the end; return the last checkpoint."""
    subprocess.run(_command(log_root, task, *flags), capture_output=True, check=True)
    return last_checkpoint(log_root)


def train_killed(log_root: Path, *flags: str, task: str = TASK) -> Path:
    """Train, kill the process without warning after five iterations, and resume without flags."""
    process = subprocess.Popen(
        _command(log_root, task, *flags, "--agent.save-interval", "4"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    # With an interval of four, the checkpoint after the fifth iteration is model_4.pt.
    while not list(log_root.glob("*/*/model_4.pt")):
        if process.poll() is not None:
            raise RuntimeError("Training ended before it could be killed.")
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    for later in log_root.glob("*/*/model_[5-9].pt"):
        later.unlink()
    return train(log_root, "--agent.resume", "True", task=task)


def last_checkpoint(log_root: Path) -> Path:
    """Return the checkpoint of the last iteration."""
    return max(
        log_root.glob(f"*/*/model_{ITERATIONS - 1}.pt"), key=lambda path: path.stat().st_mtime
    )


def same_weights(first: Path, second: Path) -> bool:
    """Return whether networks, optimizers and totals of two checkpoints are the same bits."""
    import torch

    one, two = (torch.load(path, weights_only=True) for path in (first, second))
    parts = [name for name in one if name.endswith("state_dict")]
    return all(_is_same(one[name], two.get(name)) for name in parts)


def _is_same(one: object, two: object) -> bool:
    import torch

    if isinstance(one, torch.Tensor):
        return isinstance(two, torch.Tensor) and torch.equal(one, two)
    if isinstance(one, dict):
        return (
            isinstance(two, dict)
            and one.keys() == two.keys()
            and all(_is_same(value, two[name]) for name, value in one.items())
        )
    if isinstance(one, (list, tuple)):
        return (
            isinstance(two, (list, tuple)) and len(one) == len(two) and all(map(_is_same, one, two))
        )
    return one == two


def measure_families() -> list[Row]:
    """Kill and resume a run of each task family and learner, and compare."""
    rows = []
    for task in FAMILIES:
        for learner in ("ppo", "sac"):
            flags = (*OF_FAMILIES, "--learner", learner)
            with tempfile.TemporaryDirectory() as folder:
                straight = train(Path(folder) / "straight", *flags, task=task)
                killed = train_killed(Path(folder) / "killed", *flags, task=task)
                is_same = same_weights(straight, killed)
            value = "identical bits" if is_same else "different"
            rows.append(
                Row(f"{task}, {learner}", value, "the first run", "identical bits", is_same)
            )
            print(rows[-1].what, value, flush=True)
    return rows


def measure() -> list[Row]:
    """Train four times and compare."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        straight = train(root / "straight", *FLAGS)
        again = same_weights(straight, train(root / "again", *FLAGS))
        one = train(root / "threads", *FLAGS, "--env.sim.num-threads", "1")
        threads = same_weights(straight, one)
        resumed = same_weights(straight, train_killed(root / "killed", *FLAGS))
    verdict = {True: "identical bits", False: "different"}
    return [
        Row(
            f"same seed, native, weights after {ITERATIONS} iterations",
            f"twice: {verdict[again]}; 1 thread instead of all: {verdict[threads]}",
            "the first run",
            "identical bits",
            again and threads,
        ),
        Row(
            f"{ITERATIONS} iterations straight, against 5, SIGKILL, and a resume",
            verdict[resumed],
            "the first run",
            "identical bits",
            resumed,
        ),
    ]


if __name__ == "__main__":
    print(show(measure_families() if "--families" in sys.argv else measure()))
