"""Runs that trials damage, interrupt and compare."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .commands import SMALL, TASK, Command
from .trials import Broken

SAC = (
    "--learner", "sac", "--agent.algorithm.batch-size", "64", "--agent.algorithm.num-updates", "1",
    "--agent.algorithm.learning-starts", "2", "--agent.algorithm.replay-steps", "40",
)  # fmt: skip
"""Flags of a small run of SAC."""


def train_flags(log_root: Path, iterations: int, *flags: str) -> tuple[str, ...]:
    """Return the arguments of a small training run."""
    root = ("--log-root", str(log_root), "--agent.max-iterations", str(iterations))
    return TASK, *SMALL, *root, *flags


def trained(log_root: Path, iterations: int, *flags: str) -> Path:
    """Train; return the run's folder.

    Raises:
        RuntimeError: training failed.
    """
    ended = Command("train", train_flags(log_root, iterations, *flags)).end(120.0)
    if ended.status != 0:
        raise RuntimeError(ended.said)
    return max((log_root / "cartpole").iterdir())


def copied(run: Path, name: str) -> Path:
    """Return a copy of a run below the folder `name`, the only one of its experiment."""
    folder = Path(name).resolve() / "cartpole" / run.name
    shutil.copytree(run, folder)
    return folder


def checkpoints(log_root: Path) -> list[Path]:
    """Return all checkpoints below a folder, in order of creation."""
    return sorted(log_root.glob("**/model_*.pt"), key=lambda path: path.stat().st_mtime_ns)


def check_loadable(log_root: Path) -> None:
    """Raise Broken if one of the checkpoints cannot be loaded."""
    from mjlab.rl.checkpoint import CheckpointError, load_checkpoint

    for path in checkpoints(log_root):
        try:
            load_checkpoint(path)
        except CheckpointError as error:
            raise Broken(f"{path.name} cannot be loaded: {error}") from error


def same(one: Any, other: Any) -> bool:
    """Return True if two nested contents of files are equal, numbers bit for bit."""
    import numpy as np
    import torch

    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        if one.shape != other.shape or one.dtype != other.dtype:
            return False
        return one.numpy().tobytes() == other.numpy().tobytes()
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        alike = one.shape == other.shape and one.dtype == other.dtype
        return alike and one.tobytes() == other.tobytes()
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other or (one != one and other != other)


def learned(checkpoint: Path) -> dict[str, Any]:
    """Return the learned state: networks and optimizers, without clocks."""
    from mjlab.rl.checkpoint import load_checkpoint

    content = load_checkpoint(checkpoint)
    return {key: value for key, value in content.items() if key.endswith("_state_dict")}


def leftovers(log_root: Path, patterns: Sequence[str] = ("**/.*.tmp", "**/*.tmp")) -> list[str]:
    """Return the names of temporary files below a folder."""
    return sorted({path.name for pattern in patterns for path in log_root.glob(pattern)})
