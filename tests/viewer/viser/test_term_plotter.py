"""Plots of terms."""

from __future__ import annotations

import numpy as np

from mjlab.viewer.viser import ViserTermPlotter


def term(name: str, value: float) -> tuple[str, np.ndarray]:
    return name, np.array([value])


def test_points_are_recorded_and_shown_up_to_the_length_asked_for(viser_server) -> None:
    plotter = ViserTermPlotter(viser_server, ["a", "b"], "Metrics", 3, env_idx=4)
    for value in range(5):
        plotter.update([term("a", value), term("b", -value)])
    for name, sign in (("a", 1), ("b", -1)):
        steps, values = plotter._plots[name].data
        assert steps.tolist() == [-2, -1, 0]
        assert values.tolist() == [sign * 2, sign * 3, sign * 4]
    assert "Metrics terms of environment 4" in plotter._label.content


def test_another_environment_starts_over(viser_server) -> None:
    plotter = ViserTermPlotter(viser_server, ["a"])
    plotter.update([term("a", 1.0)])
    plotter.update_env_idx(2)
    plotter.update([term("a", 5.0)])
    assert plotter._plots["a"].data[1].tolist() == [5.0]
    assert "environment 2" in plotter._label.content
