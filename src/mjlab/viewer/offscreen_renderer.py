"""Images of one environment and its neighbours, drawn without a window."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.viewer.backdrop import has_sky, move_sun, paint_sky, prepare_sun
from mjlab.viewer.camera import nearest_envs, resolve_camera
from mjlab.viewer.gl_context import open_renderer
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS as VIEWER_MODEL_FIELDS
from mjlab.viewer.model_sync import (
    compute_poses,
    copy_state,
    host_model,
    sync_model_fields,
    to_numpy,
)
from mjlab.viewer.native.visualizer import MujocoNativeDebugVisualizer

if TYPE_CHECKING:
    from mjlab.scene import Scene
    from mjlab.viewer.viewer_config import ViewerConfig

log = logging.getLogger(__name__)

_MIN_EXTENT = 4.0
_NO_PERTURBATION = mujoco.MjvPerturb()


class OffscreenRenderer:
    """Draws `cfg.env_idx` and its `cfg.max_extra_envs` nearest neighbours into an image.

    The renderer draws from a private copy of the model, whose extent is `max(4, 1.5 distance)`:
    clipping planes and shadows then do not depend on how far apart the environments lie.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cfg: ViewerConfig,
        scene: Scene,
        sim_model: Any | None = None,
        expanded_fields: set[str] | None = None,
    ) -> None:
        """Prepare; nothing is drawn and no graphics library is touched until `initialize`.

        Args:
            model: The compiled scene.
            cfg: Camera, image size and visibility.
            scene: The scene, for its entities and environment origins (num_envs, 3).
            sim_model: Batched model, to draw the randomised fields of each environment. Not
                needed where `update` gets the `Simulation`, which knows its own.
            expanded_fields: Names of the per-environment fields of `sim_model`.

        Raises:
            ValueError: The number of extra environments is negative, the image has no pixels, or
                the camera's entity or body does not exist.
        """
        if cfg.max_extra_envs < 0:
            raise ValueError(
                f"viewer.max_extra_envs is {cfg.max_extra_envs}; it must be 0 or more."
            )
        if cfg.width < 1 or cfg.height < 1:
            raise ValueError(
                f"The image is {cfg.width} x {cfg.height} pixels; "
                "viewer.width and viewer.height must be 1 or more."
            )
        self._cfg = cfg
        self._scene = scene
        self._sim_model = sim_model
        self._expanded_fields = expanded_fields if expanded_fields is not None else set()
        self._view = resolve_camera(cfg, model, scene.entities)
        self._model = _drawing_model(model, cfg, self._view.fovy)
        self._has_sky = has_sky(model)
        self._data = mujoco.MjData(self._model)
        self._option = _visibility(cfg)
        self._camera = mujoco.MjvCamera()
        self._renderer: mujoco.Renderer | None = None
        self._visualizer: MujocoNativeDebugVisualizer | None = None
        self._extra_envs: list[int] | None = None

    @property
    def renderer(self) -> mujoco.Renderer:
        """MuJoCo's renderer.

        Raises:
            RuntimeError: `initialize` has not been called.
        """
        if self._renderer is None:
            raise RuntimeError("The offscreen renderer is not open; call initialize() first.")
        return self._renderer

    def initialize(self) -> None:
        """Open the graphics context.

        Raises:
            RuntimeError: It is open already.
            RenderingUnavailableError: This machine cannot render; the text says what to install.
        """
        if self._renderer is not None:
            raise RuntimeError("The offscreen renderer is open already; call close() first.")
        self._renderer = open_renderer(self._model, self._cfg.height, self._cfg.width)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._cfg.enable_shadows
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._cfg.enable_reflections
        self._visualizer = MujocoNativeDebugVisualizer(self._renderer.scene, self._model)

    def update(
        self,
        data: Any,
        debug_vis_callback: Callable[[MujocoNativeDebugVisualizer], None] | None = None,
        camera: str | int | None = None,
    ) -> None:
        """Take up the present state.

        Args:
            data: A `Simulation`, its `data`, or a plain `MjData`.
            debug_vis_callback: Called with a visualizer for the primary environment.
            camera: Name or number of a model camera to look through, instead of the configured
                view.

        Raises:
            RuntimeError: `initialize` has not been called.
            ValueError: There is no camera of that name.
        """
        scene = self.renderer.scene
        env_idx = min(max(self._cfg.env_idx, 0), self._num_envs() - 1)
        self._load(data, env_idx)
        move_sun(self._model, self._data, self._view.target(self._data.xpos))
        self.renderer.update_scene(
            self._data, camera=self._camera_for(camera), scene_option=self._option
        )
        if debug_vis_callback is not None and self._visualizer is not None:
            self._visualizer.begin(env_idx, show_all_envs=False)
            debug_vis_callback(self._visualizer)
        for extra in self._neighbours(env_idx):
            self._load(data, extra)
            mujoco.mjv_addGeoms(
                self._model,
                self._data,
                self._option,
                _NO_PERTURBATION,
                int(mujoco.mjtCatBit.mjCAT_DYNAMIC),
                scene,
            )

    def render(self) -> np.ndarray:
        """The image of the last `update`: (height, width, 3), uint8, rows from the top.

        Raises:
            RuntimeError: `initialize` has not been called.
        """
        pixels = self.renderer.render()
        if not self._has_sky:
            paint_sky(pixels, self.renderer)
        return pixels

    def close(self) -> None:
        """Close the graphics context; may be called twice, and `initialize` again after it."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
            self._visualizer = None

    def _load(self, data: Any, env_idx: int) -> None:
        # A simulation is asked anew each time: fields may have been expanded since the last frame.
        model = getattr(data, "model", self._sim_model)
        fields = getattr(data, "expanded_fields", self._expanded_fields)
        if model is not None and fields:
            sync_model_fields(self._model, model, fields, env_idx)
        copy_state(data, env_idx, self._data)
        compute_poses(self._model, self._data)

    def _camera_for(self, name: str | int | None) -> mujoco.MjvCamera | int:
        if name is None:
            camera = self._camera
            camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            camera.lookat[:] = self._view.target(self._data.xpos)
            camera.distance = self._view.distance
            camera.azimuth = self._view.azimuth
            camera.elevation = self._view.elevation
            return camera
        names = [self._model.camera(i).name for i in range(self._model.ncam)]
        if name in names:
            return names.index(name)
        if isinstance(name, int) and 0 <= name < len(names):
            return name
        raise ValueError(f"There is no camera {name!r} in the scene. Cameras there: {names}.")

    def _num_envs(self) -> int:
        return len(self._scene.env_origins)

    def _neighbours(self, env_idx: int) -> list[int]:
        # Chosen once: terrain curricula move origins, and neighbours should not flicker.
        if self._extra_envs is None:
            self._extra_envs = nearest_envs(
                to_numpy(self._scene.env_origins), env_idx, self._cfg.max_extra_envs
            )
        return self._extra_envs


def _drawing_model(model: mujoco.MjModel, cfg: ViewerConfig, fovy: float | None) -> mujoco.MjModel:
    private = host_model(model)
    private.stat.extent = max(_MIN_EXTENT, 1.5 * cfg.distance)
    prepare_sun(private, cfg.distance)
    if fovy is not None:
        private.vis.global_.fovy = fovy
    private.vis.global_.offwidth = max(private.vis.global_.offwidth, cfg.width)
    private.vis.global_.offheight = max(private.vis.global_.offheight, cfg.height)
    # A shadow map much finer than the image costs most of the drawing time where a CPU draws.
    finest = 1 << int(np.ceil(np.log2(2 * max(cfg.width, cfg.height))))
    private.vis.quality.shadowsize = min(private.vis.quality.shadowsize, finest)
    return private


def _visibility(cfg: ViewerConfig) -> mujoco.MjvOption:
    option = mujoco.MjvOption()
    option.geomgroup[:] = cfg.geom_group
    option.sitegroup[:] = cfg.site_group
    return option
