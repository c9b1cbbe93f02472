"""Clips recorded from the page."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from viewer_fakes import FakeEnv, push

from mjlab.viewer import ViserPlayViewer
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError
from mjlab.viewer.viser import clip


class Client:
    """Browser that pressed the button."""

    client_id = 7

    def __init__(self) -> None:
        self.camera = SimpleNamespace(
            look_at=np.zeros(3), position=np.array([0.0, -4.0, 1.0]), fov=np.deg2rad(45.0)
        )
        self.downloads: dict[str, bytes] = {}
        self.notes: list[str] = []

    def send_file_download(self, name: str, content: bytes, save_immediately: bool) -> None:
        assert save_immediately
        self.downloads[name] = content

    def add_notification(self, title: str, body: str, **_: Any) -> None:
        self.notes.append(f"{title}: {body}")


@pytest.fixture
def page(viser_server, monkeypatch):
    viewer = ViserPlayViewer(FakeEnv(2), push(), viser_server=viser_server)
    viewer.setup()
    client = Client()
    monkeypatch.setattr(viser_server, "get_clients", lambda: {client.client_id: client})
    panel: Any = viewer._clip_panel
    return viewer, panel, client


def show(viewer: ViserPlayViewer) -> None:
    viewer.after_env_step()
    viewer._next_scene = 0.0
    viewer.sync_env_to_viewer()


def press(panel: Any, client: Client) -> None:
    panel._on_click(SimpleNamespace(client=client))


def finish(viewer: ViserPlayViewer, panel: Any) -> None:
    """Wait for the thread that renders, and update the page."""
    before = panel._recording
    show(viewer)
    # A thread that failed at once may have been noticed already.
    if (recording := before or panel._recording) is not None:
        recording.join()
    viewer._next_scene = 0.0
    viewer.sync_env_to_viewer()


def test_a_clip_has_a_frame_per_shown_step_and_is_downloaded(page, tmp_path) -> None:
    viewer, panel, client = page
    press(panel, client)
    for _ in range(3):
        show(viewer)
    assert panel.is_recording
    press(panel, client)
    finish(viewer, panel)
    assert not panel.is_recording
    file = tmp_path / "clip.mp4"
    file.write_bytes(client.downloads["clip.mp4"])
    reader = imageio_ffmpeg.read_frames(str(file))
    assert next(reader)["source_size"] == (960, 540)
    frames = [np.frombuffer(frame, dtype=np.uint8) for frame in reader]
    assert len(frames) == 3
    assert frames[0].std() > 10.0


def test_a_clip_ends_by_itself(page, monkeypatch) -> None:
    viewer, panel, client = page
    monkeypatch.setattr(clip, "_MAX_SECONDS", 0.05)
    press(panel, client)
    show(viewer)
    show(viewer)
    finish(viewer, panel)
    assert "clip.mp4" in client.downloads
    assert not panel.is_recording


def test_a_clip_is_sent_while_the_view_is_paused(page) -> None:
    viewer, panel, client = page
    press(panel, client)
    show(viewer)
    viewer.pause()
    press(panel, client)
    finish(viewer, panel)
    assert client.downloads["clip.mp4"]


def test_a_full_disk_ends_the_clip_and_not_the_view(page, monkeypatch) -> None:
    viewer, panel, client = page

    def fail(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(clip.ClipWriter, "add", fail)
    press(panel, client)
    show(viewer)
    press(panel, client)
    finish(viewer, panel)
    assert client.notes == ["No clip is recorded: no space left"]
    assert not panel.is_recording
    show(viewer)
    assert not client.downloads


def test_a_machine_that_cannot_render_says_so_on_the_page(page, monkeypatch) -> None:
    viewer, panel, client = page

    def fail(*_: Any) -> None:
        raise RenderingUnavailableError("no EGL library")

    monkeypatch.setattr(clip, "open_renderer", fail)
    press(panel, client)
    finish(viewer, panel)
    assert client.notes == ["No clip is recorded: no EGL library"]
    assert not client.downloads


def test_closed_pages_leave_no_recording(page) -> None:
    viewer, panel, client = page
    press(panel, client)
    show(viewer)
    recording = panel._recording
    viewer.close()
    assert not recording.is_alive()
    assert not recording.content
    assert not panel.is_recording
