"""Browser viewer of a policy in training."""

from __future__ import annotations

import pytest
from viewer_fakes import FakeEnv, push

from mjlab.viewer.viser import live
from mjlab.viewer.viser.live import LiveViewer, progress_html

STATS = {
    "iteration": 30,
    "total_iterations": 120,
    "mean_step_reward": 0.75,
    "exploring_return": 3155.2,
    "exploring_length": 421.4,
    "steps_per_second": 15321.0,
    "time_left": 3725.0,
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


def make(page: Page, take_stats=lambda: None) -> tuple[LiveViewer, list[bool]]:
    watched: list[bool] = []
    viewer = LiveViewer(FakeEnv(1), push(), page, "A task", take_stats, watched.append)
    viewer.setup()
    return viewer, watched


def test_nothing_is_stepped_drawn_or_loaded_without_a_browser(page) -> None:
    taken = []
    viewer, watched = make(page, lambda: taken.append(1))
    drawn = []
    viewer.sync_env_to_viewer = lambda: drawn.append(1)
    viewer._pacer.add(1.0)
    for _ in range(3):
        viewer.tick()
    assert (viewer.env.num_steps, drawn, taken) == (0, [], [])
    assert watched == [False]


def test_it_plays_while_a_browser_is_connected_and_does_not_catch_up(page) -> None:
    viewer, watched = make(page)
    viewer.tick()
    # Long time without a browser.
    viewer._last_tick -= 1000.0
    viewer.tick()
    page.clients = {0: object()}
    viewer._last_tick -= 0.05
    viewer.tick()
    assert 1 <= viewer.env.num_steps <= 20
    page.clients = {}
    viewer.tick()
    assert watched == [False, True, False]


def test_the_page_says_how_far_training_has_got(page) -> None:
    waiting = [None, STATS]
    viewer, _ = make(page, lambda: waiting.pop(0) if waiting else None)
    page.clients = {0: object()}
    viewer.tick()
    assert "Waiting for the first iteration" in viewer._panel.content
    viewer.tick()
    for part in (
        "A task",
        "30 of 120",
        "width:25.0%",
        "421 steps",
        "15,321 steps/s",
        "1:02 h left",
    ):
        assert part in viewer._panel.content
    # Values stay until newer ones arrive.
    viewer.tick()
    assert "30 of 120" in viewer._panel.content


def test_titles_are_text_and_times_may_be_unknown() -> None:
    content = progress_html("<b>", STATS | {"time_left": None}, age=7.2)
    assert "&lt;b&gt;" in content
    assert "7 s old" in content
    assert "starting" in content
    assert "left" not in content


def test_the_page_has_the_return_of_the_terminal() -> None:
    assert "<strong>Return:</strong> 3,155, exploring" in progress_html("", STATS, age=0.0)
    endless = STATS | {"exploring_return": None, "exploring_length": None}
    content = progress_html("", endless, age=0.0)
    assert "<strong>Reward per step:</strong> 0.75, exploring" in content
    assert "Episodes" not in content
