"""Paired comparison of success, and the judge of episodes."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from deploy_success import Judge, difference_of_success


def test_equal_outcomes_have_an_interval_about_zero():
    by, low, high = difference_of_success([True] * 60, [True] * 60)
    assert by == 0.0
    assert -low == high == pytest.approx(0.0316, abs=1e-4)


def test_difference_is_of_pairs():
    """Zero for equal rates, whichever episodes succeed; negative with more failures in MuJoCo."""
    half = [True, False] * 30
    assert difference_of_success(half, half[::-1])[0] == 0.0
    by, low, high = difference_of_success([True] * 60, half)
    assert by == -0.5
    assert low < by < high < -0.3


def judge() -> Judge:
    contract = {
        "robot": {"root_body": "trunk", "initial_height": 0.4},
        "limits": {"tilt": 1.0},
    }
    model = SimpleNamespace(body=lambda name: SimpleNamespace(jntadr=[0]))
    model.jnt_qposadr, model.jnt_dofadr = [0], [0]
    return Judge(contract, model)


def roots(tilt: float = 0.0, height: float = 0.3, turn: float = 0.0) -> np.ndarray:
    """Return two rows of a root that tilts, and moves 0.5 m/s along the world's x axis."""
    qpos, qvel = np.zeros((2, 7)), np.zeros((2, 6))
    qpos[:, 2], qpos[:, 3], qpos[:, 4] = height, math.cos(tilt / 2), math.sin(tilt / 2)
    if turn:
        qpos[:, 3], qpos[:, 6] = math.cos(turn / 2), math.sin(turn / 2)
    qvel[:, 0] = 0.5
    return judge().root(qpos, qvel)


@pytest.mark.parametrize("change", [{"tilt": 1.1}, {"height": 0.19}])
def test_tilted_and_low_robots_have_fallen(change):
    outcome = judge().outcome(roots(**change), np.zeros((2, 3)))
    assert not outcome.succeeds
    assert math.isnan(outcome.error)


def test_velocity_error_is_in_the_frame_of_the_root():
    """Turned left by 90 degrees, the robot moves to its right."""
    command = np.tile((0.0, -0.5, 0.0), (2, 1))
    assert judge().outcome(roots(turn=math.pi / 2), command).error == pytest.approx(0.0)
    assert judge().outcome(roots(), command).error == pytest.approx(0.5 * math.sqrt(2.0))
