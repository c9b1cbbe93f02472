"""Recording of clips from the page: the browser's view, rendered here, downloaded as mp4."""

from __future__ import annotations

import contextlib
import logging
import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import viser

from mjlab.utils.wrappers.video_recorder import ClipWriter
from mjlab.viewer.model_sync import compute_poses, copy_state, host_model, sync_model_fields
from mjlab.viewer.offscreen_renderer import (
    RenderingUnavailableError,
    has_sky,
    move_sun,
    open_renderer,
    paint_sky,
    prepare_sun,
)
from mjlab.viewer.viser.scene import MjlabViserScene

log = logging.getLogger(__name__)

_WIDTH, _HEIGHT = 960, 540
_MAX_SECONDS = 30.0
_LABELS = {False: "Record clip", True: "Stop and download"}


class ClipPanel:
    """Button that records the view of the browser that pressed it, one frame per displayed step.

    Frames are rendered by MuJoCo with the camera of that browser, and sent as an mp4 when recording
    stops, after 30 s at the latest.
    """

    def __init__(self, scene: MjlabViserScene, env: Any, fps: float) -> None:
        """Add the button to the current GUI container.

        Args:
            scene: Scene of the page.
            env: Unwrapped environment.
            fps: Frames per second of the clip.
        """
        self._scene, self._env, self._fps = scene, env, fps
        self._client: viser.ClientHandle | None = None
        self._recording: _Recording | None = None
        self._requested = False
        hint = "Record this view; press again to download the clip."
        self._button = scene.server.gui.add_button(
            _LABELS[False], icon=viser.Icon.VIDEO, hint=hint, color="gray"
        )
        self._button.on_click(self._on_click)

    @property
    def is_recording(self) -> bool:
        """True while frames are recorded."""
        return self._recording is not None

    def update(self) -> None:
        """Record a frame if requested, and send the clip at its end. Call from the viewer's thread
        after each displayed step."""
        if self._requested and self._recording is None:
            self._start()
        recording, client = self._recording, self._client
        if recording is None or client is None:
            return
        try:
            if self._requested and client.client_id in self._scene.server.get_clients():
                recording.add(client.camera, self._scene.env_idx, self._scene.offset)
            if recording.num_frames >= _MAX_SECONDS * self._fps or not self._requested:
                self._finish(recording, client)
        except OSError as error:
            # A full disk ends the clip, not the view.
            self.close()
            self._fail(client, error)

    def close(self) -> None:
        """Discard a running recording."""
        if self._recording is not None:
            with contextlib.suppress(OSError):
                self._recording.close()
            self._recording = None

    def _on_click(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self._client = event.client if not self._requested else self._client
            self._requested = not self._requested
            self._button.label = _LABELS[self._requested]
            # Of a paused view, too.
            self._scene.request_update()

    def _start(self) -> None:
        try:
            self._recording = _Recording(self._env, self._fps)
        except (RenderingUnavailableError, OSError) as error:
            self._fail(self._client, error)

    def _fail(self, client: viser.ClientHandle | None, error: Exception) -> None:
        self._requested = False
        self._button.label = _LABELS[False]
        log.warning("No clip is recorded. %s", error)
        if client is not None:
            client.add_notification("No clip is recorded", str(error), color="red")

    def _finish(self, recording: _Recording, client: viser.ClientHandle) -> None:
        self._requested, self._recording = False, None
        self._button.label = _LABELS[False]
        content = recording.close()
        if content and client.client_id in self._scene.server.get_clients():
            client.send_file_download("clip.mp4", content)


class _Recording:
    """Frames of one clip."""

    def __init__(self, env: Any, fps: float) -> None:
        self._env = env
        self._model = host_model(env.sim.mj_model)
        visual = self._model.vis
        visual.global_.offwidth = max(visual.global_.offwidth, _WIDTH)
        visual.global_.offheight = max(visual.global_.offheight, _HEIGHT)
        self._has_sky = has_sky(self._model)
        self._data, self._camera = mujoco.MjData(self._model), mujoco.MjvCamera()
        prepare_sun(self._model, 4.0)
        self._renderer = open_renderer(self._model, _HEIGHT, _WIDTH)
        self._folder = tempfile.TemporaryDirectory(prefix="mjlab-clip-")
        self._writer = ClipWriter(Path(self._folder.name) / "clip.mp4", fps)

    @property
    def num_frames(self) -> int:
        return self._writer.num_frames

    def add(self, view: Any, env_idx: int, offset: np.ndarray) -> None:
        """Render the current state of an environment from the camera of a browser."""
        sim, model, data = self._env.sim, self._model, self._data
        sync_model_fields(model, sim.model, sim.expanded_fields, env_idx)
        copy_state(sim, env_idx, data)
        compute_poses(model, data)
        target, position = np.asarray(view.look_at) - offset, np.asarray(view.position) - offset
        ahead = target - position
        camera = self._camera
        camera.lookat = target
        camera.distance = float(np.linalg.norm(ahead))
        camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
        camera.elevation = float(np.degrees(np.arctan2(ahead[2], np.hypot(*ahead[:2]))))
        model.vis.global_.fovy = float(np.degrees(view.fov))
        move_sun(model, data, target)
        self._renderer.update_scene(data, camera)
        pixels = self._renderer.render()
        if not self._has_sky:
            paint_sky(pixels, self._renderer)
        self._writer.add(pixels)

    def close(self) -> bytes:
        """Finish the clip and return the file; empty without frames."""
        with self._folder:
            self._renderer.close()
            path = self._writer.close()
            return b"" if path is None else path.read_bytes()
