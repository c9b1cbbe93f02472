"""Headless Chromium in tests, where one is installed."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

Send = Callable[..., dict[str, Any]]


@contextmanager
def browser(folder: Path, events: list[dict[str, Any]] | None = None) -> Iterator[Send]:
    """Yield a function that sends a command to a tab; what the tab reports is added to `events`."""
    from websockets.sync.client import connect

    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "about:blank"]
    command += ["--enable-unsafe-swiftshader"]
    command += [f"--user-data-dir={folder}", "--remote-debugging-port=0"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            port_file = folder / "DevToolsActivePort"
            wait_for(lambda: port_file.exists() and port_file.read_text().count("\n"))
            port = port_file.read_text().split("\n")[0]
            tabs = json.load(urlopen(f"http://127.0.0.1:{port}/json"))
            tab = next(tab for tab in tabs if tab["type"] == "page")
            address = tab["webSocketDebuggerUrl"]
            # A tab that draws without a GPU may not answer a ping for long.
            with connect(address, max_size=None, ping_interval=None) as connection:

                def send(method: str, **params: Any) -> dict[str, Any]:
                    connection.send(json.dumps({"id": 1, "method": method, "params": params}))
                    while (got := json.loads(connection.recv())).get("id") != 1:
                        if events is not None:
                            events.append(got)
                    return got["result"]

                yield send
        finally:
            process.terminate()


def evaluated(send: Send, expression: str) -> Any:
    """Return the value of an expression of JavaScript in the tab; None for undefined."""
    return send("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get(
        "value"
    )


def wait_for(condition: Callable[[], Any], seconds: float = 20.0) -> Any:
    """Return the first value of `condition` that is true."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found
