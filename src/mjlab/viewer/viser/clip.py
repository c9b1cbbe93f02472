"""Recording of clips from the page: the browser's view, rendered here, downloaded as mp4."""

from __future__ import annotations

import logging
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import viser

from mjlab.utils.wrappers.video_recorder import ClipWriter
from mjlab.viewer.model_sync import (
    VIEWER_MODEL_FIELDS,
    compute_poses,
    copy_state,
    host_model,
    sync_model_fields,
)
from mjlab.viewer.offscreen_renderer import (
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

    While recording, states and cameras are kept, so the view keeps its pace. A thread renders them by
    MuJoCo when recording stops, after 30 s at the latest, and the browser downloads an mp4. Drawings such
    as arrows are not part of a clip.
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
        """True while a clip is recorded or rendered."""
        return self._recording is not None

    def update(self) -> None:
        """Keep a frame if requested, and send a rendered clip. Call from the viewer's thread after
        each displayed step."""
        client = self._client
        if client is None:
            return
        if self._requested and self._recording is None:
            self._recording = _Recording(self._env, self._fps, self._scene.request_update)
        recording = self._recording
        if recording is None:
            return
        is_connected = client.client_id in self._scene.server.get_clients()
        if recording.is_done:
            self._deliver(recording, client if is_connected else None)
        elif self._requested:
            if is_connected:
                recording.add(client.camera, self._scene.env_idx, self._scene.offset)
            self._requested = recording.num_frames < _MAX_SECONDS * self._fps
        if self._recording is not None and not self._requested:
            recording.stop()
            self._button.label = f"Rendering, {recording.progress:.0%}"

    def close(self) -> None:
        """Discard a running recording."""
        if self._recording is not None:
            self._recording.discard()
            self._recording = None

    def _on_click(self, event: viser.GuiEvent) -> None:
        is_rendering = self._recording is not None and not self._requested
        if event.client is not None and not is_rendering:
            self._client = event.client if not self._requested else self._client
            self._requested = not self._requested
            self._button.label = _LABELS[self._requested]
            # Of a paused view, too.
            self._scene.request_update()

    def _deliver(self, recording: _Recording, client: viser.ClientHandle | None) -> None:
        """Send the clip, or the reason why there is none."""
        self._recording, self._requested = None, False
        self._button.label = _LABELS[False]
        if recording.error is not None:
            log.warning("No clip is recorded. %s", recording.error)
            if client is not None:
                client.add_notification("No clip is recorded", str(recording.error), color="red")
        elif client is not None and recording.content:
            client.send_file_download("clip.mp4", recording.content, save_immediately=True)


@dataclass(frozen=True)
class _Frame:
    """State of an environment and camera of a browser."""

    qpos: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray
    fields: dict[str, np.ndarray]
    """Model fields of the environment that affect rendering."""
    lookat: np.ndarray
    position: np.ndarray
    fov: float
    """Vertical field of view (rad)."""


class _Recording(threading.Thread):
    """Frames of one clip, and the thread that renders them after `stop`."""

    def __init__(self, env: Any, fps: float, notify: Callable[[], None]) -> None:
        """Start the thread. `notify` is called from it when there is progress, and at its end."""
        super().__init__(daemon=True)
        self.content = b""
        """The file, once the thread has ended; empty without frames."""
        self.error: Exception | None = None
        """Why there is no clip."""
        self.is_done = False
        """True once `content` or `error` is final."""
        self._env, self._fps, self._notify = env, fps, notify
        self._model = host_model(env.sim.mj_model)
        self._data = mujoco.MjData(self._model)
        self._fields = sorted(env.sim.expanded_fields & VIEWER_MODEL_FIELDS)
        self._frames: list[_Frame] = []
        self._num_rendered = 0
        self._stopped, self._discarded = threading.Event(), threading.Event()
        self.start()

    @property
    def num_frames(self) -> int:
        return len(self._frames)

    @property
    def progress(self) -> float:
        """Fraction of the frames that are rendered, in [0, 1]."""
        return self._num_rendered / max(len(self._frames), 1)

    def add(self, view: Any, env_idx: int, offset: np.ndarray) -> None:
        """Keep the current state of an environment and the camera of a browser."""
        sim, model, data = self._env.sim, self._model, self._data
        sync_model_fields(model, sim.model, sim.expanded_fields, env_idx)
        copy_state(sim, env_idx, data)
        self._frames.append(
            _Frame(
                data.qpos.copy(),
                data.mocap_pos.copy(),
                data.mocap_quat.copy(),
                {name: getattr(model, name).copy() for name in self._fields},
                np.asarray(view.look_at) - offset,
                np.asarray(view.position) - offset,
                float(view.fov),
            )
        )

    def stop(self) -> None:
        """End the recording, and render. Call `add` no more."""
        self._stopped.set()

    def discard(self) -> None:
        """End without a clip."""
        self._discarded.set()
        self._stopped.set()
        self.join(timeout=5.0)

    def run(self) -> None:
        """Open the renderer, wait for the end of the recording, and render."""
        try:
            self._render()
        except Exception as error:
            # A missing library or a full disk ends the clip, not the view.
            self.error = error
        finally:
            # Before the last notice: a paused view is updated by notices only.
            self.is_done = True
            self._notify()

    def _render(self) -> None:
        # A model of its own: `add` writes the other from the viewer's thread.
        model = host_model(self._env.sim.mj_model)
        visual = model.vis
        visual.global_.offwidth = max(visual.global_.offwidth, _WIDTH)
        visual.global_.offheight = max(visual.global_.offheight, _HEIGHT)
        data, camera, without_sky = mujoco.MjData(model), mujoco.MjvCamera(), not has_sky(model)
        prepare_sun(model, 4.0)
        with (
            tempfile.TemporaryDirectory(prefix="mjlab-clip-") as folder,
            open_renderer(model, _HEIGHT, _WIDTH) as renderer,
        ):
            writer = ClipWriter(Path(folder) / "clip.mp4", self._fps)
            self._stopped.wait()
            try:
                for frame in self._frames:
                    if self._discarded.is_set():
                        break
                    _pose(model, data, camera, frame)
                    renderer.update_scene(data, camera)
                    pixels = renderer.render()
                    if without_sky:
                        paint_sky(pixels, renderer)
                    writer.add(pixels)
                    self._num_rendered += 1
                    self._notify()
            finally:
                path = writer.close()
            if path is not None:
                self.content = path.read_bytes()


def _pose(
    model: mujoco.MjModel, data: mujoco.MjData, camera: mujoco.MjvCamera, frame: _Frame
) -> None:
    """Set model, state and camera to those of a frame."""
    for name, value in frame.fields.items():
        getattr(model, name)[:] = value
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = (
        frame.qpos,
        frame.mocap_pos,
        frame.mocap_quat,
    )
    compute_poses(model, data)
    ahead = frame.lookat - frame.position
    camera.lookat = frame.lookat
    camera.distance = float(np.linalg.norm(ahead))
    camera.azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
    camera.elevation = float(np.degrees(np.arctan2(ahead[2], np.hypot(*ahead[:2]))))
    model.vis.global_.fovy = float(np.degrees(frame.fov))
    move_sun(model, data, frame.lookat)
