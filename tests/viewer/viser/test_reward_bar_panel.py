"""Reward bars: means over the last second."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from mjlab.viewer.viser import RewardBarPanel


def term(name: str, value: float) -> tuple[str, np.ndarray]:
    return name, np.array([value])


def test_bars_are_cut_with_a_warning_and_compare_with_the_largest(viser_server, caplog) -> None:
    with caplog.at_level(logging.WARNING):
        panel = RewardBarPanel(viser_server, ["a", "b<", "c"], 0.02, max_terms=2)
    assert "3 terms" in caplog.text
    panel.update([term("a", 2.0), term("b<", -1.0), term("c", 100.0)])
    assert "width:100.0%" in panel._html.content
    assert "width:50.0%" in panel._html.content
    assert "b&lt;" in panel._html.content
    assert ">c<" not in panel._html.content
    # The sum is of all terms.
    assert f"{101.0:+.4f}" in panel._html.content


@pytest.mark.parametrize(("update_dt", "mean"), [(0.1, 94.5), (0.25, 97.5), (3.0, 99.0)])
def test_the_window_is_a_second(viser_server, update_dt, mean) -> None:
    panel = RewardBarPanel(viser_server, ["a"], update_dt)
    for value in range(100):
        panel.update([term("a", value)])
    assert f"{mean:+.4f}" in panel._html.content
    panel.clear_histories()
    panel.refresh()
    assert f"{0.0:+.4f}" in panel._html.content


def test_hidden_terms_have_no_bar_and_the_sum_comes_first(viser_server) -> None:
    weights = {"a": 1.0, "b": 0.0}
    panel = RewardBarPanel(
        viser_server, ["a", "b"], 0.1, is_shown=lambda name: weights[name] != 0.0
    )
    panel.update([term("a", 2.0), term("b", 0.0)])
    assert ">b<" not in panel._html.content
    assert panel._html.content.index(">sum<") < panel._html.content.index(">a<")
    # A curriculum may raise the weight.
    weights["b"] = 1.0
    panel.update([term("a", 2.0), term("b", -0.5)])
    assert ">b<" in panel._html.content
