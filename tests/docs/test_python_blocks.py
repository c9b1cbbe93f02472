"""Python in the pages and in README.md runs as pasted: each block alone, with its imports."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md"]
PAGES += [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]

# Pages whose blocks belong together, and are run by another test.
ELSEWHERE = {
    # One file, part by part: `test_tutorial_snippets`.
    "docs/tutorial/cartpole.md",
    # After the diffs of the page: `test_extension_pages`.
    "docs/how-to/add_actuator.md",
    "docs/how-to/add_command.md",
    "docs/how-to/add_engine.md",
    "docs/how-to/add_sensor.md",
    "docs/how-to/add_term.md",
    # One session, which trains for minutes: `test_other_learners`, with smaller numbers.
    "docs/guides/other_learners.md",
    # Files that `new-robot` writes: `tests/scripts/test_new_robot`.
    "docs/how-to/own_robot.md",
}

_EVALUATED = (
    *("--agent.evaluation.trigger-return", "-1e9", "--agent.evaluation.first-iteration", "0"),
    *("--agent.evaluation.min-interval", "1", "--agent.evaluation.num-episodes", "4"),
    *("--env.episode-length-s", "0.1", "--agent.max-iterations", "2", "--num-envs", "8"),
)


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    python_path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": python_path}
    return subprocess.run(
        [sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """Return a folder with what the commands of the pages write before their Python runs."""
    task = "Mjlab-Cartpole-Swingup"
    for command in (
        ("deploy", "go1", "--output", "go1_bundle", "--steps", "20"),
        ("train", task, "--profile", "cpu", "--device", "cpu", *_EVALUATED),
    ):
        done = run(tmp_path, "-m", "mjlab.cli.main", *command)
        assert done.returncode == 0, done.stderr
    np.savez(tmp_path / "nan_dump_latest.npz", _metadata='{"num_envs": 1}')
    drives = "ACTUATORS, EVENTS = (), {}\n"
    (tmp_path / "my_robot_drives.py").write_text(drives, encoding="utf-8")
    return tmp_path


def test_blocks_run_as_pasted(workplace: Path) -> None:
    folder = workplace / "blocks"
    folder.mkdir()
    for page in PAGES:
        name = page.relative_to(ROOT).as_posix()
        for number, block in enumerate([] if name in ELSEWHERE else blocks(page), start=1):
            path = folder / f"{name.replace('/', '_')}_{number}.py"
            path.write_text(block, encoding="utf-8")
    done = run(workplace, str(Path(__file__).with_name("run_blocks.py")), str(folder))
    assert done.returncode == 0, done.stderr


def test_pages_run_elsewhere_have_python() -> None:
    assert {name for name in ELSEWHERE if not (ROOT / name).is_file()} == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_is_marked_as_such(page: Path) -> None:
    """Else a block would not be run."""
    fences = re.findall(r"^ *```+ *(\w*)", page.read_text("utf-8"), re.MULTILINE)
    assert not {"py", "python3", "pycon", "Python"} & set(fences)
    assert not re.search(r"^ +```python", page.read_text("utf-8"), re.MULTILINE)
