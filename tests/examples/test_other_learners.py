"""The examples that solve the swing-up with other libraries."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "example"),
    [("stable_baselines3", "sb3_swing_up"), ("skrl", "skrl_swing_up")],
)
def test_the_swing_up_is_solved(library, example):
    pytest.importorskip(library)
    spec = importlib.util.spec_from_file_location(example, EXAMPLES / f"{example}.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    assert spec.loader is not None
    spec.loader.exec_module(module)
    assert module.train(seed=1)[0] >= 900.0
