"""Files written at the end of training."""

from __future__ import annotations

import pytest
from commands import SMALL, TASK
from matplotlib.figure import Figure


def test_the_curve_of_a_resumed_run_is_whole(run, tmp_path, monkeypatch):
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *args, **kwargs: figures.append(self))
    flags = [*SMALL, "--log-root", str(tmp_path), "--agent.max-iterations"]
    assert run("train", TASK, *flags, "2").status == 0
    outcome = run("train", TASK, *flags, "3", "--agent.resume", "True")
    assert outcome.status == 0, outcome.err
    for figure, iterations in zip(figures, ([1, 2], [1, 2, 3]), strict=True):
        curve, goal = figure.axes[0].lines
        assert list(curve.get_xdata()) == iterations
        assert goal.get_ydata()[0] == pytest.approx(900.0)
