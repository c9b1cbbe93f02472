"""The worked diffs of *Add a term, a command, a sensor, ...* apply, their code runs, and their tests pass."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "how-to").glob("add_*.md"))


def diffs(page: Path) -> list[str]:
    return re.findall(r"```diff\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def apply(text: str, folder: Path, *flags: str) -> None:
    subprocess.run(["git", "apply", *flags, "-"], input=text, text=True, cwd=folder, check=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_diffs_apply_and_are_short(page: Path) -> None:
    assert all(len(text.splitlines()) < 40 for text in diffs(page))
    apply("".join(diffs(page)), ROOT, "--check")


@pytest.mark.slow
def test_code_runs_and_tests_of_the_diffs_pass(tmp_path: Path) -> None:
    for name in ("src", "tests"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    files = []
    for page in PAGES:
        for text in diffs(page):
            apply(text, tmp_path)
            files += re.findall(r"^\+\+\+ b/(tests/\S+)", text, re.MULTILINE)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "src")}
    for page in PAGES:
        code = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        subprocess.run([sys.executable, "-c", "\n".join(code)], env=environment, check=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    assert len(files) == len(PAGES)
