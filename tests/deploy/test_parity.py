"""Parity of the runtime: every stock task and robots of others, over the steps that `deploy` records."""

from __future__ import annotations

import importlib
import sys

import pytest
from bundles import TOLERANCE, worst_differences, write_random
from foreign_robots import download

from mjlab.tasks import registry

STEPS = 400
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("task", registry.list_tasks())
def test_stock_task(task, tmp_path):
    worst = worst_differences(write_random(task, tmp_path / "bundle", steps=STEPS))
    assert max(worst.values()) < TOLERANCE, worst


@pytest.mark.parametrize("robot", ["aliengo", "berkeley_humanoid"])
def test_foreign_robot(robot, run, tmp_path, monkeypatch):
    """Of a package that `new-robot` writes, registered within this process."""
    model, package = download(robot, tmp_path / "models"), tmp_path / robot
    stock, tasks = registry.list_tasks(), dict(registry._tasks)
    monkeypatch.setattr(registry, "_tasks", dict(tasks))
    outcome = run("new_robot", str(model), "--output", str(package), "--name", robot)
    assert outcome.status == 0, outcome.err
    # `new-robot` has registered the tasks that it tried.
    monkeypatch.setattr(registry, "_tasks", tasks)
    monkeypatch.syspath_prepend(str(package / "src"))
    importlib.import_module(robot)
    added = [task for task in registry.list_tasks() if task not in stock]
    assert added
    for task in added:
        worst = worst_differences(write_random(task, tmp_path / task, steps=STEPS))
        assert max(worst.values()) < TOLERANCE, worst
    for module in [m for m in sys.modules if m.partition(".")[0] == robot]:
        del sys.modules[module]
