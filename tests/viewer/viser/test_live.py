"""Browser viewer of a policy in training."""

from __future__ import annotations

import numpy as np
import pytest
from viewer_fakes import FakeEnv, push

from mjlab.viewer.viser import live
from mjlab.viewer.viser.live import LiveViewer, curve_data, curve_scales, progress_html

PROGRESS = {
    "iteration": 30,
    "total_iterations": 120,
    "rows": [("time", "at most 1:02 h left"), ("return", "741, exploring; 900 solves")],
    "unit": "return",
    "curve": {10: 100.0, 20: 300.0, 30: 741.0},
    "evaluations": {20: 280.0},
    "goal": 900.0,
    "time": 0.0,
}


class Page:
    """Page server with browsers connected and disconnected by the test."""

    def __init__(self, server):
        self._server = server
        self.clients = {}

    def __getattr__(self, name):
        return getattr(self._server, name)

    def get_clients(self):
        return self.clients


@pytest.fixture
def page(viser_server, monkeypatch) -> Page:
    monkeypatch.setattr(live, "_SLEEP_UNWATCHED", 0.0)
    monkeypatch.setattr(live, "_WEIGHTS_PERIOD", 0.0)
    monkeypatch.setattr(live, "_PANEL_PERIOD", 0.0)
    return Page(viser_server)


def make(page: Page, take_progress=lambda: None, on_ready=lambda: None) -> LiveViewer:
    viewer = LiveViewer(FakeEnv(1), push(), page, "A task", take_progress, on_ready)
    viewer.setup()
    return viewer


def test_nothing_is_stepped_drawn_or_loaded_without_a_browser(page) -> None:
    taken, ready, drawn = [], [], []
    viewer = make(page, lambda: taken.append(1), lambda: ready.append(1))
    assert ready == [1]
    viewer.sync_env_to_viewer = lambda: drawn.append(1)
    viewer._pacer.add(1.0)
    for _ in range(3):
        viewer.tick()
    assert (viewer.env.num_steps, drawn, taken) == (0, [], [])


def test_it_plays_while_a_browser_is_connected_and_does_not_catch_up(page) -> None:
    viewer = make(page)
    # Long time without a browser.
    viewer._last_tick -= 1000.0
    viewer.tick()
    page.clients = {0: object()}
    viewer._last_tick -= 0.05
    viewer.tick()
    assert 1 <= viewer.env.num_steps <= 20


def test_page_shows_the_newest_progress(page) -> None:
    waiting = [None, PROGRESS]
    viewer = make(page, lambda: waiting.pop(0) if waiting else None)
    page.clients = {0: object()}
    viewer.tick()
    assert "Waiting for the policy" in viewer._panel.content
    # Values stay until newer ones arrive.
    for _ in range(2):
        viewer.tick()
        for part in ("A task", "30 of 120", "width:25.0%", "1:02 h left", "741, exploring"):
            assert part in viewer._panel.content
        np.testing.assert_array_equal(viewer._plot.data[1], [100.0, 300.0, 741.0])


def test_legend_names_what_is_drawn() -> None:
    content = progress_html("", PROGRESS, age=0.0)
    assert all(part in content for part in ("return, exploring", "evaluated", "goal"))
    content = progress_html("", PROGRESS | {"evaluations": {}, "goal": None}, age=0.0)
    assert "evaluated" not in content
    assert "goal" not in content


def test_curve_has_evaluations_and_goal() -> None:
    iterations, curve, goal, evaluations = curve_data(
        PROGRESS | {"evaluations": {20: 280.0, 25: 500.0}}
    )
    np.testing.assert_array_equal(iterations, [10.0, 20.0, 25.0, 30.0])
    np.testing.assert_array_equal(curve, [100.0, 300.0, np.nan, 741.0])
    np.testing.assert_array_equal(goal, [900.0] * 4)
    np.testing.assert_array_equal(evaluations, [np.nan, 280.0, 500.0, np.nan])


@pytest.mark.parametrize(
    ("progress", "x", "y"),
    [
        (PROGRESS, (10.0, 30.0), (60.0, 940.0)),
        ({}, (0.0, 1.0), (-0.05, 1.05)),
        ({"curve": {1: float("nan"), 2: 5.0}}, (1.0, 2.0), (4.9997, 5.0003)),
    ],
)
def test_scales_hold_all_points(progress, x, y) -> None:
    scales = curve_scales(curve_data(progress))
    assert scales["x"]["range"] == x
    assert scales["y"]["range"] == pytest.approx(y, abs=1e-3)
