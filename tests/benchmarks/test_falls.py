"""`benchmarks/falls.py` attributes falls to circumstances."""

from __future__ import annotations

import copy
import importlib
from pathlib import Path
from types import ModuleType

import pytest
import torch

from mjlab.tasks.registry import load_env_cfg

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def falls(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("falls")


def mask(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)


def test_the_ratio_compares_falls_with_time(falls):
    found = falls.Falls(step_dt=0.5)
    for _ in range(30):
        found.add({"all": mask(1, 1, 1, 1), "pushed": mask(1, 0, 0, 0)}, mask(0, 0, 0, 0))
    found.add({"all": mask(1, 1, 1, 1), "pushed": mask(1, 0, 0, 0)}, mask(1, 1, 0, 0))
    text = str(found)
    assert "2 falls in 1.0 minutes" in text
    assert "| pushed | 25 % | 1 | 50 % | 2.00 |" in text


def test_a_table_without_falls_has_no_ratio(falls):
    found = falls.Falls(step_dt=0.02)
    found.add({"all": mask(1, 1), "pushed": mask(0, 0)}, mask(0, 0))
    assert "| pushed | 0 % | 0 |  |  |" in str(found)


def test_copies_of_the_config_time_pushes(falls):
    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    pushed = []
    cfg.events["push_robot"].func = lambda env, env_ids, **params: pushed.append(env_ids)
    age = falls.time_pushes(cfg)
    event = copy.deepcopy(cfg).events["push_robot"]
    event.func(None, torch.tensor([2]), **event.params)
    assert (age == 0).nonzero().flatten().tolist() == [2]
    assert len(pushed) == 1
    cfg.events.pop("push_robot")
    assert falls.time_pushes(cfg) is None
