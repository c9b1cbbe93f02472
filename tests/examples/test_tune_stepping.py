"""The example that searches gains of the stepping controller."""

from __future__ import annotations

import numpy as np
import pytest
from example_files import load_example


@pytest.fixture(scope="module")
def example():
    pytest.importorskip("cma")
    return load_example("tune_stepping")


def test_good_gains_score_more_than_weak_ones(example):
    env = example.make_env("Mjlab-Velocity-Flat-Unitree-G1", 16, 1.88, 0.0)
    own, weak = example.scores(env, np.array([example.START, 0.1 * example.START]), 2.0)
    env.close()
    assert own > weak


def test_the_search_returns_the_best_gains_that_it_tried(example, monkeypatch, capsys):
    tried = []

    def scores(env, sets, seconds):
        tried.extend(sets)
        return -np.abs(sets[:, 0] - 0.15)

    monkeypatch.setattr(example, "scores", scores)
    found = example.search(None, population=6, generations=5, seconds=1.0, seed=1)
    gaps = [abs(gains[0] - 0.15) for gains in tried]
    assert len(gaps) == 30
    assert abs(found.lift - 0.15) == pytest.approx(min(gaps))
    assert repr(found) in capsys.readouterr().out
