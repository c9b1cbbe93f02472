"""Page that reads a gamepad, in Chromium, with a stand-in for `navigator.getGamepads`."""

from __future__ import annotations

import time

import pytest
from browser import browser, evaluated, needs_chromium, wait_for

from mjlab.viewer.gamepad import stick_position
from mjlab.viewer.page_server import page_url, serve_page

STAND_IN = """
  window.pad = {connected: true, id: "Stand-in", axes: [0, 0, 0, 0]};
  navigator.getGamepads = () => [null, window.pad];
"""


@pytest.mark.slow
@needs_chromium
def test_sticks_reach_the_server(tmp_path):
    server, sticks = serve_page(port=18500), []
    server.on_gamepad = sticks.append
    try:
        with browser(tmp_path) as send:

            def move(*axes):
                """Move the sticks; return the last position that arrived."""
                count = len(sticks)
                send("Runtime.evaluate", expression=f"pad.axes = {list(axes)}")
                wait_for(lambda: len(sticks) > count)
                time.sleep(0.3)
                return sticks[-1]

            send("Page.enable")
            send("Page.addScriptToEvaluateOnNewDocument", source=STAND_IN)
            send("Page.navigate", url=f"{page_url(server)}/gamepad")
            named = "document.querySelector('p')?.textContent.startsWith('Stand-in')"
            wait_for(lambda: evaluated(send, named))
            # Centered sticks leave the sampled commands alone.
            time.sleep(0.3)
            assert sticks == []
            assert move(0.0, -1.0, 0.0, 0.0) == (1.0, 0.0, 0.0)
            assert move(-1.0, 0.05, 0.55, 0.0) == (0.0, 1.0, -0.5)
            # A held stick is sent once.
            count = len(sticks)
            time.sleep(0.3)
            assert len(sticks) == count
            send("Runtime.evaluate", expression="pad.connected = false")
            wait_for(lambda: sticks[-1] == (0.0, 0.0, 0.0))
    finally:
        server.stop()


def test_a_position_has_three_shares():
    assert stick_position("forward=-1&left=0.5&turn=1") == (-1.0, 0.5, 1.0)
    for query in ("", "forward=1&left=0", "forward=1&left=0&turn=inf"):
        with pytest.raises(ValueError):
            stick_position(query)
