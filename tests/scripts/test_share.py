"""`mjlab share`: the page of a run, and the page in a browser without a network."""

from __future__ import annotations

import base64
import io
import json
import shutil
from pathlib import Path

import pytest
from browser import browser, evaluated, needs_chromium, wait_for
from PIL import Image

from mjlab.scripts.demo import DEMOS
from mjlab.scripts.share import MAX_BYTES

SHORT = ("--seconds", "0.4", "--device", "cpu")


@pytest.fixture(scope="module")
def shared(run, trained, tmp_path_factory) -> Path:
    """Return a page of a run with an evaluation."""
    folder = shutil.copytree(trained, tmp_path_factory.mktemp("share") / "run")
    flags = ("--num-episodes", "4", "--max-steps", "6", "--device", "cpu")
    path = str(folder / "evaluation.json")
    task = json.loads((folder / "run.json").read_text())["task"]
    outcome = run("evaluate", task, *flags, "--checkpoint-file", str(folder), "--output", path)
    assert outcome.status == 0, outcome.err
    page = folder / "page.html"
    outcome = run("share", str(folder), "--output", str(page), *SHORT)
    assert outcome.status == 0, outcome.err
    assert str(page) in outcome.out
    return page


def test_page_has_the_run_and_its_evaluation(shared, trained):
    text = shared.read_text()
    assert shared.stat().st_size < MAX_BYTES
    info = json.loads((trained / "run.json").read_text())
    for value in (info["task"], "model_1.pt", "exploring policy", "4 episodes, seed 0"):
        assert value in text
    assert info["machine"] in text


def test_evaluations_of_other_checkpoints_are_not_shown(run, shared):
    page = shared.with_name("other.html")
    policy = str(shared.parent / "model_0.pt")
    outcome = run("share", policy, "--output", str(page), *SHORT)
    assert outcome.status == 0, outcome.err
    assert "--checkpoint-file" in outcome.err
    text = page.read_text()
    assert "4 episodes, seed 0" not in text
    assert "Not measured" in text


@pytest.mark.parametrize("name", DEMOS)
def test_demos_are_shared_with_their_evaluation_and_training(name, run, tmp_path):
    page = tmp_path / "demo.html"
    outcome = run("share", name, "--output", str(page), "--num-episodes", "1", *SHORT)
    assert outcome.status == 0, outcome.err
    text = page.read_text()
    assert "400 episodes, seed 1000" in text
    assert ("lin_vel_x (m/s)" in text) == (name != "g1-tracking")
    for fact, value in (("iterations", DEMOS[name].iteration), ("seed of training", 1)):
        assert f"<tr><th>{fact}</th><td>{value}</td></tr>" in text


def test_pages_need_a_policy(run, tmp_path):
    outcome = run("share", "go1", "--agent", "zero", "--output", str(tmp_path / "p.html"), *SHORT)
    assert outcome.status == 1
    assert "expected 'trained'" in outcome.message
    assert not (tmp_path / "p.html").exists()


@pytest.mark.parametrize("flag", ["--output", "--evaluation"])
def test_wrong_files_are_named_before_the_recording(run, tmp_path, flag):
    flags = ("--output", str(tmp_path / "p.html"), flag, str(tmp_path))
    outcome = run("share", "go1", *flags)
    assert outcome.status == 1
    assert outcome.message.startswith(f"error: {flag}: ")
    assert "Recording" not in outcome.err
    assert not list(tmp_path.iterdir())


def test_facts_of_another_checkpoint_are_not_claimed(run, shared, tmp_path):
    source = shutil.copytree(shared.parent, tmp_path / "run")
    (exported,) = source.glob("*.onnx")
    page = tmp_path / "new" / "page.html"
    outcome = run("share", str(exported), "--output", str(page), "--num-episodes", "1", *SHORT)
    assert outcome.status == 0, outcome.err
    assert "<th>iterations</th>" not in page.read_text()


def pixel(send, x: float, y: float) -> tuple[int, ...]:
    """Return the color of the tab at a share of its width and height."""
    shot = base64.b64decode(send("Page.captureScreenshot", format="png")["data"])
    image = Image.open(io.BytesIO(shot)).convert("RGB")
    return image.getpixel((int(x * image.width), int(y * image.height)))


def show(send, width: int) -> None:
    """Set the width of the tab, in pixels."""
    size = {"width": width, "height": 500, "deviceScaleFactor": 1, "mobile": False}
    send("Emulation.setDeviceMetricsOverride", **size)


@needs_chromium
def test_page_plays_without_a_network(shared, tmp_path):
    events: list = []
    slider = "document.querySelector('iframe').contentDocument?.querySelector('[role=slider]')"
    now = f"Number({slider}?.getAttribute('aria-valuenow'))"
    cursor = "Number(document.documentElement.style.getPropertyValue('--share'))"
    with browser(tmp_path, events) as send:
        for domain in ("Network", "Runtime", "Page"):
            send(f"{domain}.enable")
        send(
            "Network.emulateNetworkConditions",
            offline=True, latency=0, downloadThroughput=0, uploadThroughput=0,
        )  # fmt: skip
        # Small, because it is drawn without a GPU.
        show(send, 320)
        send("Page.navigate", url=shared.as_uri())
        wait_for(lambda: evaluated(send, f"{now} > 0 && {cursor} > 0"), 180.0)
        # The ground; above it is the warning about the missing GPU.
        wait_for(lambda: pixel(send, 0.5, 0.7) != (255, 255, 255), 180.0)
        for width in (400, 1600):
            show(send, width)
            assert evaluated(send, "document.documentElement.scrollWidth") <= width
    requests = [
        event["params"]["request"]["url"]
        for event in events
        if event.get("method") == "Network.requestWillBeSent"
    ]
    assert requests
    assert all(url.startswith(("file:", "data:", "blob:", "about:")) for url in requests)
    assert not [event for event in events if event.get("method") == "Runtime.exceptionThrown"]
