"""`benchmarks/gpu.py`: all parts run on the CPU, and keep what was measured when they fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

GPU = Path(__file__).resolve().parents[2] / "benchmarks" / "gpu.py"


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script as a module."""
    monkeypatch.syspath_prepend(str(GPU.parent))
    import gpu

    return gpu


@pytest.mark.slow
def test_parts_run_on_the_cpu(tmp_path: Path) -> None:
    # As on a machine where mjlab is not installed: no path of this project.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = [sys.executable, str(GPU), "--device", "cpu", "--tiny", "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd="/")
    assert done.returncode == 0, done.stdout + done.stderr
    table = (tmp_path / "table.md").read_text()
    parts = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert set(parts) == {"kernels", "parity", "speed", "learning", "cameras"}
    for part in parts.values():
        assert part["status"] == "done"
        assert part["machine"]["device"] == "cpu"
        assert part["rows"]
        assert all(row["measured"] in table for row in part["rows"])
    assert all(row["reached"] for row in parts["parity"]["rows"])
    # The bare loop casts as many rays as the scan of the terrain has.
    assert "the same" in " ".join(row["what"] for row in parts["speed"]["rows"])


def test_failed_parts_keep_their_rows(gpu: Any, tmp_path: Path, monkeypatch: Any) -> None:
    def fails(options: Any) -> Any:
        yield gpu.Row("first", "1", "", "", None)
        raise ValueError("expected 3, got 2")

    monkeypatch.setitem(gpu.PARTS, "parity", gpu.Part(fails, 1.0))
    gpu.run_part("parity", gpu.Options("cpu", True, 1.0), tmp_path)
    content = json.loads((tmp_path / "parity.json").read_text())
    assert content["status"] == "failed"
    assert content["rows"][0]["what"] == "first"
    assert "expected 3, got 2" in content["error"]
    assert "## parity: failed" in gpu.table(tmp_path)


@pytest.mark.slow
def test_parts_end_with_their_time(gpu: Any, tmp_path: Path) -> None:
    gpu.start_part("kernels", gpu.Options("cpu", True, 1.0), tmp_path)
    assert json.loads((tmp_path / "kernels.json").read_text())["status"] == "out of time"


def test_other_physics_misses_parity(gpu: Any) -> None:
    native, other = (gpu.make_env(gpu.CARTPOLE, 4, "cpu", "native") for _ in range(2))
    same = list(gpu.compare(gpu.CARTPOLE, native, other, 2))
    assert [row.reached for row in same] == [True, True]
    other.sim.expand_model_fields(("dof_damping",))
    other.sim.model.dof_damping.add_(5.0)
    reached = [row.reached for row in gpu.compare(gpu.CARTPOLE, native, other, 2)]
    assert reached == [True, False]
