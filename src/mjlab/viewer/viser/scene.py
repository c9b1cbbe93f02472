"""The 3-D scene of the browser viewer: mjviser's scene, our camera, debug drawings."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import viser
from mjviser import ViserMujocoScene

from mjlab.viewer.camera import CameraView, first_moving_body
from mjlab.viewer.model_sync import sync_model_fields, to_numpy
from mjlab.viewer.viser.debug_items import ViserDebugVisualizer
from mjlab.viewer.viser.variants import GeomVariants

_FOV_RANGE = (20, 150)
_DEFAULT_FOV = 60.0
_CONTACT_WIDENING = 4.2


class MjlabViserScene(ViserMujocoScene):
    """mjviser's scene of all environments, seen through the camera of a `ViewerConfig`.

    Following a body moves the scene, not the camera, so that the person keeps control of it. All
    drawing happens in the thread that calls `draw`; the page's controls only set values and ask
    for a redraw (`redraw_requested`).
    """

    def __init__(
        self,
        server: viser.ViserServer,
        mj_model: mujoco.MjModel,
        num_envs: int,
        view: CameraView | None = None,
        geom_group: tuple[int, ...] = (1, 1, 1, 0, 0, 0),
        site_group: tuple[int, ...] = (1, 1, 1, 0, 0, 0),
    ) -> None:
        """Send the shapes of `mj_model` to the page, `num_envs` times.

        Args:
            server: The page's server.
            mj_model: The compiled scene. mjviser writes colours and sizes into its visual
                settings, so give it a private copy (`model_sync.host_model`).
            num_envs: Environments to draw.
            view: Camera; by default MuJoCo's for the whole model.
            geom_group: Which geom groups are shown at first.
            site_group: Which site groups are shown at first.
        """
        super().__init__(server, mj_model, num_envs)
        # As mjviser has them, contact points disappear in a robot's feet.
        mj_model.vis.scale.contactwidth *= _CONTACT_WIDENING
        self.view = view if view is not None else _whole_model_view(mj_model)
        self.geom_groups_visible = [bool(shown) for shown in geom_group]
        self.site_groups_visible = [bool(shown) for shown in site_group]
        self._sync_visibilities()
        followed = self.view.body_id
        self.camera_tracking_enabled = followed is not None
        self._tracked_body_id = followed if followed is not None else first_moving_body(mj_model)
        self.debug = ViserDebugVisualizer(server, mj_model)
        self.debug_enabled = True
        self.show_all_debug = False
        self.offset = np.zeros(3)
        """How far the scene was moved when it was drawn last, (3,)."""
        self._variants = GeomVariants(self)
        self._redraw = threading.Event()
        self.set_refresh_handler(self._redraw.set)
        self._aim_initial_camera()

    @property
    def redraw_requested(self) -> bool:
        """Whether a control was changed since the last `draw`."""
        return self._redraw.is_set()

    def request_redraw(self) -> None:
        """Ask for a redraw, from any thread."""
        self._redraw.set()

    def draw(self, sim: Any, debug_vis: Callable[[ViserDebugVisualizer], None] | None) -> None:
        """Show the present state of all environments; call it between steps.

        Args:
            sim: The simulation. What is drawn is copied here, before anything is sent.
            debug_vis: Draws the overlays of the selected (or of all) environments.
        """
        self._redraw.clear()
        env_idx = self.env_idx
        arrays = {
            name: to_numpy(getattr(sim.data, name)).copy()
            for name in ("xpos", "xmat", "mocap_pos", "mocap_quat")
            if not name.startswith("mocap") or self.mj_model.nmocap > 0
        }
        xmat = arrays["xmat"].reshape(*arrays["xpos"].shape[:2], 3, 3)
        self.offset = offset = self._offset(arrays["xpos"][env_idx])
        mj_data = self._forward_selected(sim, env_idx)
        with self._update_lock, self.server.atomic():
            self._variants.update(sim, arrays["xpos"], xmat, offset)
            self._update_visualization_locked(
                arrays["xpos"],
                xmat,
                arrays.get("mocap_pos", np.zeros((self.num_envs, 0, 3))),
                arrays.get("mocap_quat", np.zeros((self.num_envs, 0, 4))),
                env_idx,
                offset,
                mj_data,
            )
            self._draw_debug(debug_vis, env_idx, offset)

    def aim(self) -> None:
        """Put every connected camera where the configuration wants it."""
        for client in self.server.get_clients().values():
            client.camera.position = self._look_at() + self.view.offset()
            client.camera.look_at = self._look_at()

    def create_scene_gui(
        self,
        camera_distance: float = -1.0,
        camera_azimuth: float = 120.0,
        camera_elevation: float = 20.0,
    ) -> None:
        """Add the environment and camera controls; the camera's pose is that of `view`."""
        if self.num_envs > 1:
            with self.server.gui.add_folder("Environment"):
                self._create_environment_gui()
        with self.server.gui.add_folder("Camera"):
            self._create_camera_gui()

    def _offset(self, body_xpos: np.ndarray) -> np.ndarray:
        if not self.camera_tracking_enabled or self._tracked_body_id is None:
            return np.zeros(3)
        return -np.asarray(body_xpos[self._tracked_body_id], dtype=float)

    def _forward_selected(self, sim: Any, env_idx: int) -> mujoco.MjData | None:
        """Contacts, inertia and so on of the selected environment, where any of it is shown."""
        if not self._any_decor_visible():
            return None
        sync_model_fields(self.mj_model, sim.model, sim.expanded_fields, env_idx)
        sim.copy_to_host(env_idx, self.mj_data)
        mujoco.mj_forward(self.mj_model, self.mj_data)
        return self.mj_data

    def _draw_debug(
        self,
        debug_vis: Callable[[ViserDebugVisualizer], None] | None,
        env_idx: int,
        offset: np.ndarray,
    ) -> None:
        self.debug.clear()
        self.debug.env_idx = env_idx
        self.debug.show_all_envs = self.show_all_debug and not self.show_only_selected
        if debug_vis is not None and self.debug_enabled:
            debug_vis(self.debug)
        self.debug.send(offset)

    def _look_at(self) -> np.ndarray:
        return np.zeros(3) if self.camera_tracking_enabled else np.asarray(self.view.lookat)

    def _fov(self) -> float:
        return float(np.clip(self.view.fovy or _DEFAULT_FOV, *_FOV_RANGE))

    def _aim_initial_camera(self) -> None:
        camera = self.server.initial_camera
        camera.position = self._look_at() + self.view.offset()
        camera.look_at = self._look_at()
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = np.deg2rad(self._fov())

    def _create_environment_gui(self) -> None:
        gui = self.server.gui
        select = gui.add_slider(
            "Select",
            min=0,
            max=self.num_envs - 1,
            step=1,
            initial_value=self.env_idx,
            hint=f"Environment in view, 0 to {self.num_envs - 1}.",
        )
        hide = gui.add_checkbox(
            "Hide others", self.show_only_selected, hint="Show only the selected environment."
        )

        @select.on_update
        def _(_: Any) -> None:
            self.env_idx = int(select.value)
            self.request_redraw()

        @hide.on_update
        def _(_: Any) -> None:
            self.show_only_selected = hide.value
            self.request_redraw()

    def _create_camera_gui(self) -> None:
        gui = self.server.gui
        track = gui.add_checkbox(
            "Track camera",
            self.camera_tracking_enabled,
            disabled=self._tracked_body_id is None,
            hint="Keep the followed body in the middle.",
        )
        fov = gui.add_slider(
            "FOV (°)",
            min=_FOV_RANGE[0],
            max=_FOV_RANGE[1],
            step=1,
            initial_value=round(self._fov()),
            hint="Vertical field of view.",
        )
        again = gui.add_button("Reset camera", icon=viser.Icon.VIDEO)

        @track.on_update
        def _(_: Any) -> None:
            self.camera_tracking_enabled = track.value
            self._aim_initial_camera()
            self.aim()
            self.request_redraw()

        @fov.on_update
        def _(_: Any) -> None:
            for client in self.server.get_clients().values():
                client.camera.fov = float(np.deg2rad(fov.value))

        @again.on_click
        def _(_: Any) -> None:
            self.aim()


def _whole_model_view(model: mujoco.MjModel) -> CameraView:
    center = tuple(float(x) for x in model.stat.center)
    return CameraView(
        body_id=None,
        lookat=(center[0], center[1], center[2]),
        distance=3.0 * float(model.stat.extent),
        azimuth=120.0,
        elevation=-20.0,
        fovy=None,
    )
