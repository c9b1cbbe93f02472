"""The tests marked `cuda`: the cases of the engine suite with Warp on the GPU, native on the CPU."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from measure import Row

from gpu_parts.options import Options

_ROOT = Path(__file__).resolve().parents[2]
_NEEDED = ("pytest", "hypothesis")
_FOLDERS = ("tests/sim",)
# On the CPU a few cases show that the part works.
_TINY = "cartpole and (derived or rays)"


def measure(options: Options) -> Iterator[Row]:
    """Run the tests in a process; yield one row that names failures.

    Raises:
        ModuleNotFoundError: a dependency of the tests is not installed.
        RuntimeError: some tests failed, or pytest could not run; the message ends with its output.
    """
    missing = missing_for_tests()
    if missing:
        raise ModuleNotFoundError(
            f"The tests need {' and '.join(missing)}: python -m pip install {' '.join(missing)}"
        )
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "tests.xml"
        code, output = _run_pytest(report, options)
        print(output, flush=True)
        if report.exists():
            yield _row(report, options.device)
    if code != 0:
        raise RuntimeError(f"pytest ended with {code}:\n{output[-8000:]}")


def missing_for_tests() -> list[str]:
    """Return missing packages of the tests."""
    missing = []
    for name in _NEEDED:
        # Import the package: one of its dependencies may be missing.
        try:
            importlib.import_module(name)
        except ImportError as error:
            missing.append(error.name or name)
    return missing


def pytest_command(options: Options) -> list[str]:
    """Return the command that runs the tests."""
    folders = [str(_ROOT / folder) for folder in _FOLDERS]
    command = [sys.executable, "-m", "pytest", *folders, "-m", "cuda", "-q", "--tb=short"]
    command += ["-p", "no:cacheprovider", "-c", str(_ROOT / "pyproject.toml")]
    return [*command, "-k", _TINY] if options.tiny else command


def environment_of_tests(options: Options) -> dict[str, str]:
    """Return the environment variables of the tests: the device of those marked `cuda`."""
    return {**os.environ, "MJLAB_TEST_CUDA_DEVICE": options.device}


def _run_pytest(report: Path, options: Options) -> tuple[int, str]:
    process = subprocess.Popen(
        [*pytest_command(options), f"--junitxml={report}"],
        cwd=_ROOT,
        env=environment_of_tests(options),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        output, _ = process.communicate()
    finally:
        process.kill()
        process.wait()
    return process.returncode, output


def _row(report: Path, device: str) -> Row:
    cases = list(ElementTree.parse(report).iter("testcase"))
    wrong = [c for c in cases if c.find("failure") is not None or c.find("error") is not None]
    skipped = [case for case in cases if case.find("skipped") is not None]
    passed = len(cases) - len(wrong) - len(skipped)
    names = "; ".join(str(case.get("name")) for case in wrong[:20]) or "-"
    return Row(
        f"tests marked `cuda`, Warp on {device}, native on the CPU",
        f"{passed} passed, {len(wrong)} failed, {len(skipped)} skipped",
        f"failed: {names}",
        "all of them passed, none skipped",
        passed > 0 and not wrong and not skipped,
    )
