"""The proof on a GPU runs, in all its parts, and keeps what it has measured whatever happens."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"
PARTS = ("kernels", "tests", "parity", "speed", "learning", "cameras")

# A part of an own making, in place of those that need torch.
STUB = """
import os, signal, subprocess, sys, time
from measure import Row


def measure(options):
    yield Row("first", "1", "", "", None)
    {rest}
"""
ENDS = {
    "kernels": 'yield Row("second", "2", "", "at least 1", True)',
    "tests": 'yield Row("second", "2", "", "at least 3", False)',
    "parity": 'raise ValueError("expected 3, got 2")',
    "speed": "os.kill(os.getpid(), signal.SIGKILL)",
    "learning": """
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    (options.output / "child").write_text(str(child.pid))
    try:
        child.wait()
    finally:
        child.kill()
        child.wait()""",
    "cameras": "import a_package_that_is_missing",
}


def run(
    folder: Path,
    *flags: str,
    timeout: float = 300.0,
    cwd: str | Path = "/",
    python_path: str | None = None,
) -> subprocess.CompletedProcess[str]:
    # As on a machine where mjlab is not installed: no path of this project, unless one is given.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if python_path is not None:
        environment["PYTHONPATH"] = python_path
    command = [sys.executable, str(folder / "gpu.py"), *flags]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=timeout, cwd=cwd
    )


def content(output: Path, part: str) -> dict[str, Any]:
    return json.loads((output / f"{part}.json").read_text())


@pytest.mark.slow
def test_every_part_runs_on_the_cpu(tmp_path: Path) -> None:
    done = run(BENCHMARKS, "--device", "cpu", "--tiny", "--in-process", "--output", str(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    for part in PARTS:
        record = content(tmp_path, part)
        assert record["status"] == "done"
        assert record["machine"]["device"] == "cpu"
        assert record["rows"]
        table = (tmp_path / "table.md").read_text()
        assert all(row["measured"] in table for row in record["rows"])
    assert {path.name for path in tmp_path.iterdir()} == {"table.md", *(f"{p}.json" for p in PARTS)}
    (tests,) = content(tmp_path, "tests")["rows"]
    assert tests["reached"]
    assert not tests["measured"].startswith("0 passed")
    assert all(row["reached"] for row in content(tmp_path, "parity")["rows"])
    compared = " ".join(row["what"] for row in content(tmp_path, "parity")["rows"])
    assert "Cartpole" in compared
    assert "Flat-Unitree-Go1" in compared
    timed = " ".join(row["what"] for row in content(tmp_path, "speed")["rows"])
    assert "Cartpole" in timed
    assert "Rough-Unitree-Go1" in timed
    # With rays of the bare loop, as many as the scan of the terrain has.
    assert "the same" in timed


@pytest.fixture
def stubs(tmp_path: Path) -> Path:
    """The script, with parts that end in every way there is."""
    folder = tmp_path / "benchmarks"
    (folder / "gpu_parts").mkdir(parents=True)
    for name in ("gpu.py", "measure.py", "gpu_parts/__init__.py", "gpu_parts/options.py"):
        shutil.copy(BENCHMARKS / name, folder / name)
    (folder / "gpu_parts/machine.py").write_text("def described(device): return {'device': device}")
    for part, rest in ENDS.items():
        (folder / f"gpu_parts/{part}.py").write_text(STUB.format(rest=rest))
    return folder


def test_parts_that_fail_keep_their_rows_and_let_the_others_go_on(stubs: Path, tmp_path: Path):
    output = tmp_path / "results"
    done = run(stubs, "--minutes", "0.5", "--seconds", "4", "--output", str(output))
    assert done.returncode == 1
    found = {part: content(output, part) for part in PARTS}
    statuses = {part: record["status"] for part, record in found.items()}
    assert statuses == {
        **dict.fromkeys(("kernels", "tests"), "done"),
        **dict.fromkeys(("parity", "speed", "cameras"), "failed"),
        "learning": "out of time",
    }
    for part in PARTS[:-1]:
        assert found[part]["rows"][0]["what"] == "first"
    assert "expected 3, got 2" in found["parity"]["error"]
    assert "-9" in found["speed"]["error"]
    # What a part has started ends with it.
    with pytest.raises(ProcessLookupError):
        os.kill(int((output / "child").read_text()), 0)
    everything = (output / "table.md").read_text()
    assert all(f"## {part}: {status}" in everything for part, status in statuses.items())
    assert "Not passed: tests, parity, speed, learning, cameras." in done.stdout


def test_a_part_without_time_is_not_started(stubs: Path, tmp_path: Path) -> None:
    flags = ("--part", "kernels", "--minutes", "0.09", "--output", str(tmp_path / "results"))
    assert run(stubs, *flags).returncode == 1
    status = content(tmp_path / "results", "kernels")["status"]
    assert status == "not started: no time was left"


def test_processes_of_parts_find_modules_of_a_relative_path(stubs: Path, tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site/only_there.py").write_text("")
    part = """
    code = subprocess.run([sys.executable, "-c", "import only_there"], cwd="/").returncode
    yield Row("found in another folder", str(code), "", "", code == 0)"""
    (stubs / "gpu_parts/kernels.py").write_text(STUB.format(rest=part))
    flags = ("--part", "kernels", "--output", str(tmp_path / "results"))
    done = run(stubs, *flags, cwd=tmp_path, python_path=f"site{os.pathsep}")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("gpu")


def test_parts_that_take_all_they_may_leave_the_later_ones_enough(gpu: Any) -> None:
    total = left = 60 * gpu.MINUTES - 5
    limits = {}
    for position, part in enumerate(PARTS):
        limits[part] = gpu.time_limit(part, PARTS[position + 1 :], left)
        left -= limits[part]
    assert sum(limits.values()) == pytest.approx(total)
    for part, limit in limits.items():
        assert gpu.PARTS[part].least <= limit <= gpu.PARTS[part].seconds, part
    assert limits["kernels"] > 150


def test_too_little_time_is_shared_by_all_parts(gpu: Any) -> None:
    left, limits = 100.0, []
    for position, part in enumerate(PARTS):
        limits.append(gpu.time_limit(part, PARTS[position + 1 :], left) / gpu.PARTS[part].least)
        left -= gpu.time_limit(part, PARTS[position + 1 :], left)
    assert limits == pytest.approx([limits[0]] * len(PARTS))
    assert gpu.time_limit("cameras", [], 1000.0) == gpu.PARTS["cameras"].seconds


def test_what_a_package_of_the_tests_lacks_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_parts import tests

    assert tests.missing_for_tests() == []
    monkeypatch.setitem(sys.modules, "sortedcontainers", None)
    for name in [name for name in sys.modules if name.partition(".")[0] == "hypothesis"]:
        monkeypatch.delitem(sys.modules, name)
    assert tests.missing_for_tests() == ["sortedcontainers"]


def test_the_first_task_compiles_alone_and_few_others_at_a_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_parts import kernels
    from gpu_parts.options import Options

    task = "import time; a = time.time(); time.sleep(0.3); print(a, time.time())"
    commands = {str(k): [sys.executable, "-c", task] for k in range(5)}
    monkeypatch.setattr(kernels, "_commands", lambda options: commands)
    monkeypatch.setattr(kernels, "available_cores", lambda: 5)
    rows = list(kernels.measure(Options("cpu", True, tmp_path, 60.0)))
    assert [row.what[0] for row in rows][0] == "0"
    assert sorted(row.what[0] for row in rows) == ["0", "1", "2", "3", "4"]
    times = sorted(tuple(map(float, row.compared_with.split())) for row in rows)
    for begin, _ in times:
        assert sum(start <= begin < end for start, end in times) <= 2
    assert all(begin >= times[0][1] for begin, _ in times[1:])


def test_training_that_does_not_end_when_told_to_is_scored_by_its_checkpoint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_parts import learning
    from gpu_parts.options import Options

    deaf = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); time.sleep(60)"
    start = subprocess.Popen
    monkeypatch.setattr(
        learning.subprocess, "Popen", lambda command: start([sys.executable, "-c", deaf])
    )
    begin = time.monotonic()
    assert learning._train(tmp_path, Options("cpu", True, tmp_path, 2.0))[1], "it was not cut off"
    assert time.monotonic() - begin < 20


@pytest.mark.parametrize(("part", "status"), [("kernels", 0), ("tests", 1), ("cameras", 1)])
def test_a_part_is_asked_for_alone(stubs: Path, tmp_path: Path, part: str, status: int) -> None:
    output = tmp_path / "results"
    begin = time.monotonic()
    assert run(stubs, "--part", part, "--output", str(output)).returncode == status
    assert time.monotonic() - begin < 30
    assert [path.stem for path in output.glob("*.json")] == [part]
    if part == "cameras":
        assert "a_package_that_is_missing" in content(output, part)["error"]


@pytest.mark.parametrize("flags", [("--part", "everything"), ("--device", "gpu")])
def test_flags_that_say_nothing_are_refused(stubs: Path, flags: tuple[str, ...]) -> None:
    done = run(stubs, *flags)
    assert done.returncode != 0
    assert flags[1] in done.stderr


def test_another_engine_that_computes_something_else_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_parts import parity
    from gpu_parts.tasks import CARTPOLE, make_env

    native, other = (make_env(CARTPOLE, 4, "cpu", "native") for _ in range(2))
    same = list(parity.compare(CARTPOLE, native, other, 2))
    assert [row.reached for row in same] == [True, True]
    assert "largest 0.0" in same[1].measured
    other.sim.expand_model_fields(("dof_damping",))
    other.sim.model.dof_damping.add_(5.0)
    assert [row.reached for row in parity.compare(CARTPOLE, native, other, 2)] == [True, False]
    monkeypatch.setattr(parity, "_STATE", ("qvel",))
    other.sim.reset()
    assert [row.reached for row in parity.compare(CARTPOLE, native, other, 2)] == [False, False]
