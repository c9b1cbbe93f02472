"""Bitwise repeatability of training: other thread counts, and resume after a kill."""

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


def _command(log_root: Path, *flags: str) -> list[str]:
    command = [sys.executable, "-m", "mjlab.scripts.train", TASK, "--num-envs", "512"]
    command += ["--device", "cpu", "--log-root", str(log_root), "--agent.seed", "7"]
    return [*command, "--agent.max-iterations", str(ITERATIONS), *flags]


def train(log_root: Path, *flags: str) -> Path:
    """Train to the end; return the last checkpoint."""
    subprocess.run(_command(log_root, *flags), capture_output=True, check=True)
    return last_checkpoint(log_root)


def train_killed(log_root: Path) -> Path:
    """Train, kill the process without warning after five iterations, and resume."""
    process = subprocess.Popen(
        _command(log_root, "--agent.save-interval", "4"),
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
    return train(log_root, "--agent.resume", "True")


def last_checkpoint(log_root: Path) -> Path:
    """Return the checkpoint of the last iteration."""
    return max(
        log_root.glob(f"*/*/model_{ITERATIONS - 1}.pt"), key=lambda path: path.stat().st_mtime
    )


def same_weights(first: Path, second: Path) -> bool:
    """Return whether all networks and the optimizer of two checkpoints are the same bits."""
    import torch

    one, two = (torch.load(path, weights_only=True) for path in (first, second))
    for part in ("actor_state_dict", "critic_state_dict"):
        if one[part].keys() != two[part].keys():
            return False
        if not all(torch.equal(value, two[part][name]) for name, value in one[part].items()):
            return False
    moments = (one["optimizer_state_dict"]["state"], two["optimizer_state_dict"]["state"])
    return all(
        torch.equal(values["exp_avg_sq"], moments[1][index]["exp_avg_sq"])
        for index, values in moments[0].items()
    )


def measure() -> list[Row]:
    """Train four times and compare."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        straight = train(root / "straight")
        again = same_weights(straight, train(root / "again"))
        threads = same_weights(straight, train(root / "threads", "--env.sim.num-threads", "1"))
        resumed = same_weights(straight, train_killed(root / "killed"))
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
    print(show(measure()))
