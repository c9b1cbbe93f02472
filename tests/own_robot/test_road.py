"""From a model file to an evaluated policy, by the commands that a user types."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from foreign_robots import ROBOTS, download
from small_robots import write_quadruped

from mjlab.tasks import registry

FLAGS = ("--profile", "cpu", "--device", "cpu")


@pytest.fixture
def own_tasks(monkeypatch) -> None:
    """Let a test register tasks."""
    monkeypatch.setattr(registry, "_tasks", dict(registry._tasks))


def test_road_of_a_small_quadruped(run, tmp_path: Path, monkeypatch, own_tasks) -> None:
    model, folder, logs = (
        write_quadruped(tmp_path / "model"),
        tmp_path / "package",
        tmp_path / "logs",
    )
    name = "road_dog"
    with pytest.MonkeyPatch.context() as patch:
        # The command imports the package for its check, here in the process of the later commands.
        patch.setattr("mjlab.tasks.registry.register_mjlab_task", lambda **task: None)
        outcome = run("new_robot", str(model), "--output", str(folder), "--name", name)
    assert outcome.status == 0, outcome.err
    assert "train Velocity-Flat-Road-Dog" in outcome.out
    monkeypatch.syspath_prepend(str(folder / "src"))
    importlib.import_module(name)
    task, root = "Velocity-Flat-Road-Dog", ("--log-root", str(logs))
    outcome = run("train", task, *FLAGS, *root, "--num-envs", "8", "--agent.max-iterations", "1")
    assert outcome.status == 0, outcome.err
    flags = ("--num-episodes", "4", "--max-steps", "10", "--json", "True", *root, "--device", "cpu")
    outcome = run("evaluate", task, *flags)
    assert outcome.status == 0, outcome.err
    result = json.loads(outcome.out)
    assert result["num_episodes"] == 4
    # Hardly trained: it errs as if it stood.
    assert 0.5 < result["metrics"]["lin_vel_error_share"]["mean"] < 3.0
    for module in [m for m in sys.modules if m.partition(".")[0] == name]:
        del sys.modules[module]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_road_of_a_foreign_robot(robot: str, tmp_path: Path) -> None:
    source, folder = download(robot, tmp_path / "models"), tmp_path / robot
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder / "src"), *sys.path])}

    def command(*words: str) -> str:
        """Run a command in a new process; return what it prints."""
        outcome = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, check=False,
            cwd=tmp_path, env=environment,
        )  # fmt: skip
        assert outcome.returncode == 0, outcome.stdout + outcome.stderr
        return outcome.stdout

    def mjlab(*words: str) -> str:
        return command("-c", "from mjlab.cli.main import main; main()", *words)

    mjlab("new-robot", str(source), "--output", str(folder), "--name", robot)
    pretend_installed(folder, robot)
    # The package's own tests: it stands, and its tasks can be stepped.
    command("-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder / "tests"))
    tasks = [task for task in mjlab("list-envs").split() if robot in task.lower().replace("-", "_")]
    task = next(task for task in tasks if "Rough" not in task)
    mjlab("train", task, *FLAGS, "--num-envs", "32", "--agent.max-iterations", "2")
    found = mjlab("evaluate", task, "--num-episodes", "8", "--max-steps", "50", "--json", "True")
    result = json.loads(found)
    assert result["num_episodes"] == 8
    assert all(abs(value["mean"]) < 1e3 for value in result["metrics"].values())


def pretend_installed(folder: Path, name: str) -> None:
    """Write the metadata of an installation beside the modules, without building the package."""
    info = folder / "src" / f"{name}-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[mjlab.tasks]\n{name} = {name}\n")
