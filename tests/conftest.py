"""Settings of the whole suite."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

# Tests run several processes at a time; one thread each keeps them from fighting over the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from commands import Outcome

# A shared machine is slow at times, which says nothing about the code.
settings.register_profile("mjlab", deadline=None, derandomize=True)
settings.load_profile("mjlab")

# Device of tests marked `cuda`. `cpu` lets them run without a GPU, which shows that they work.
CUDA_DEVICE = os.environ.get("MJLAB_TEST_CUDA_DEVICE", "cuda:0")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests marked `cuda` where their device is missing."""
    import torch

    if CUDA_DEVICE == "cpu" or torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU"))


@pytest.fixture(scope="session", autouse=True)
def discovered_tasks() -> None:
    """Discover the tasks once: tests that replace the registry by a copy take them along."""
    from mjlab.tasks.registry import list_tasks

    list_tasks()


@pytest.fixture(scope="session")
def cuda_device() -> str:
    """Device of tests marked `cuda`."""
    return CUDA_DEVICE


@pytest.fixture(scope="session")
def gl() -> None:
    """Skip where this machine cannot render offscreen."""
    import mujoco

    from mjlab.viewer.offscreen_renderer import RenderingUnavailableError, open_renderer

    try:
        open_renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))


@pytest.fixture
def viser_server() -> Iterator:
    """A page's server on a free port of this machine."""
    import viser

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    yield server
    server.stop()


@pytest.fixture(scope="session")
def run() -> Callable[..., Outcome]:
    """Return a function that runs a command."""
    from commands import run_script

    return run_script


@pytest.fixture(scope="session")
def run_main() -> Callable[..., Outcome]:
    """Return a function that calls an entry point."""
    from commands import run_main

    return run_main


@pytest.fixture(scope="session")
def train(run) -> Callable[..., Path]:
    """Return a function that trains a little and returns the run's folder."""
    from commands import SMALL, TASK

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
