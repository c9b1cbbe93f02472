"""Fixtures of the command tests."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from commands import SMALL, TASK, Outcome, run_script
from commands import run_main as run_entry_point


@pytest.fixture(scope="session")
def run() -> Callable[..., Outcome]:
    """Return a function that runs a command."""
    return run_script


@pytest.fixture(scope="session")
def run_main() -> Callable[..., Outcome]:
    """Return a function that calls an entry point."""
    return run_entry_point


@pytest.fixture(scope="session")
def train(run) -> Callable[..., Path]:
    """Return a function that trains a little and returns the run's folder."""

    def train(log_root: Path, iterations: int, *flags: str, status: int = 0) -> Path:
        experiment = log_root / "cartpole"
        before = set(experiment.iterdir()) if experiment.is_dir() else set()
        argv = [TASK, *SMALL, "--log-root", str(log_root)]
        outcome = run("train", *argv, "--agent.max-iterations", str(iterations), *flags)
        assert outcome.status == status, outcome.err
        (run_dir,) = set(experiment.iterdir()) - before
        return run_dir

    return train


@pytest.fixture(scope="session")
def trained(train, tmp_path_factory) -> Path:
    """Return the folder of a finished run of two iterations; not to be changed."""
    return train(tmp_path_factory.mktemp("trained") / "logs", 2)
