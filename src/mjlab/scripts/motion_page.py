"""A page in the browser that plays a motion."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import mujoco
from mjviser import ViserMujocoScene

from mjlab.scripts.csv_to_npz_run import pose
from mjlab.viewer.page_server import page_url, serve_page

if TYPE_CHECKING:
    import viser

    from mjlab.tasks.tracking.motion_file import Motion


class MotionPage:
    """Shows a robot on a frame of a motion, which runs by itself or follows a slider."""

    def __init__(self, server: viser.ViserServer, motion: Motion, model: mujoco.MjModel) -> None:
        """Add robot and controls.

        Args:
            server: The page's server.
            motion: The motion.
            model: Its robot, whose free joint comes first, with whatever stands around it.
        """
        self._motion, self._model = motion, model
        self._data = mujoco.MjData(model)
        self._scene = ViserMujocoScene(server, model, num_envs=1)
        self._playing = server.gui.add_checkbox("Play", True)
        self._speed = server.gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0)
        self._slider = server.gui.add_slider("Frame", 0, motion.num_frames - 1, 1, 0)
        self._slider.on_update(self._chosen)
        self._frame = 0.0
        self._shown: int | None = None

    @property
    def frame(self) -> int:
        """The frame that is shown."""
        return int(self._frame)

    def advance(self, seconds: float) -> None:
        """Show the frame that is due after so much time; the motion begins anew at its end."""
        if self._playing.value:
            self._frame += seconds * (self._motion.fps or 50.0) * self._speed.value
            self._frame %= self._motion.num_frames
            self._slider.value = self.frame
        if self._shown != self.frame:
            self._shown = self.frame
            pose(self._model, self._data, self._motion, self.frame)
            self._scene.update_from_mjdata(self._data)

    def _chosen(self, event: Any) -> None:
        # What the page itself sets has no client.
        if event.client is not None:
            self._playing.value = False
            self._frame = float(self._slider.value)


def show_motion(motion: Motion, model: mujoco.MjModel, host: str, port: int) -> None:
    """Serve the page until Ctrl-C."""
    server = serve_page(host, port)
    page = MotionPage(server, motion, model)
    print(f"Open {page_url(server)} in a browser. Ctrl-C ends.", flush=True)
    last = time.perf_counter()
    try:
        while True:
            now = time.perf_counter()
            page.advance(now - last)
            last = now
            time.sleep(1.0 / 50.0)
    finally:
        server.stop()
