"""Page that reads a gamepad, in Chromium, with a stand-in for `navigator.getGamepads`."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from contextlib import contextmanager
from urllib.request import urlopen

import pytest

from mjlab.viewer.gamepad import stick_position
from mjlab.viewer.page_server import page_url, serve_page

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
STAND_IN = """
  window.pad = {connected: true, id: "Stand-in", axes: [0, 0, 0, 0]};
  navigator.getGamepads = () => [null, window.pad];
"""


@contextmanager
def browser(folder):
    """Yield a function that sends a command to a tab of a headless Chromium."""
    from websockets.sync.client import connect

    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "about:blank"]
    command += [f"--user-data-dir={folder}", "--remote-debugging-port=0"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            port_file = folder / "DevToolsActivePort"
            wait_for(lambda: port_file.exists() and port_file.read_text().count("\n"))
            port = port_file.read_text().split("\n")[0]
            tabs = json.load(urlopen(f"http://127.0.0.1:{port}/json"))
            tab = next(tab for tab in tabs if tab["type"] == "page")
            with connect(tab["webSocketDebuggerUrl"], max_size=None) as connection:

                def send(method, **params):
                    connection.send(json.dumps({"id": 1, "method": method, "params": params}))
                    while (got := json.loads(connection.recv())).get("id") != 1:
                        pass
                    return got["result"]

                yield send
        finally:
            process.terminate()


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
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
            wait_for(lambda: send("Runtime.evaluate", expression=named)["result"].get("value"))
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
