"""Trials with faults of users, machines and the network: `make torture`.

Signals at random moments, damaged and hostile files, full disks, wrong flags, broken physics, malformed
clients. A trial holds if nothing fails silently, gets lost or hangs, and an error of a command is one
message without a traceback. Requires Linux.
"""

from __future__ import annotations

import gc
import importlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from .commands import preload
from .conftest import MINUTES
from .trials import RESULTS, run_family

pytestmark = pytest.mark.robustness

FAMILIES = (
    "kills", "signals", "store", "resumes", "damage", "limits", "command_lines", "config_files",
    "physics", "page", "origins", "names", "own_code", "sweeps", "sizes", "checkpoints",
    "replays", "ranges",
)  # fmt: skip


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "family" in metafunc.fixturenames:
        parts = metafunc.config.getoption("--parts", None)
        metafunc.parametrize("family", parts or FAMILIES)


@pytest.fixture(scope="session")
def folder() -> Iterator[Path]:
    """Folder of all files of the trials, which are forked from this process."""
    source = str(Path(__file__).parents[2] / "src")
    path = Path(tempfile.mkdtemp(prefix="torture-"))
    with pytest.MonkeyPatch.context() as patch:
        # Child processes must find the same files, and leave no others.
        patch.setenv("PYTHONPATH", source, prepend=os.pathsep)
        patch.setenv("TMPDIR", str(path / "tmp"))
        patch.setattr(tempfile, "tempdir", str(path / "tmp"))
        (path / "tmp").mkdir()
        preload()
        # Forked processes share memory until one writes to it.
        gc.collect()
        gc.freeze()
        yield path
    shutil.rmtree(path, ignore_errors=True)


def test_all_trials_hold(family: str, folder: Path, request: pytest.FixtureRequest) -> None:
    option = request.config.getoption
    module = importlib.import_module(f".{family}", __package__)
    count = max(1, round(module.TRIALS * option("--minutes", MINUTES) / MINUTES))
    only = option("--trial", None)
    numbers = range(count) if only is None else [only]
    seed = option("--seed", 0)
    result = run_family(family, module, numbers, seed, folder / family, show=only is not None)
    request.config.stash.setdefault(RESULTS, []).append(result)
    assert not result.failed, "\n".join(verdict.line(seed) for verdict in result.failed)
