"""Offscreen rendering of one environment and its neighbors.

`OffscreenRenderer` renders environments; `open_renderer` opens MuJoCo's renderer for any model.
Both raise `RenderingUnavailableError` on a machine that cannot render. Models without a skybox get
a painted sky, and directional lights merge into one sun that follows the camera target.
"""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import weakref
from collections.abc import Callable
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.utils import graphics
from mjlab.utils.errors import (
    MjlabError,
    UnknownNameError,
    WrongStateError,
    check_count,
    check_exists,
)
from mjlab.utils.memory import check_memory
from mjlab.viewer.camera import nearest_envs, resolve_camera
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS as VIEWER_MODEL_FIELDS
from mjlab.viewer.model_sync import (
    compute_poses,
    copy_state,
    host_model,
    sync_model_fields,
    to_numpy,
)
from mjlab.viewer.native.visualizer import MujocoNativeDebugVisualizer, add_moving_geoms

if TYPE_CHECKING:
    from mjlab.scene import Scene
    from mjlab.viewer.viewer_config import ViewerConfig

_MAX_GEOMS = 10_000
_MIN_EXTENT = 4.0

# Graphics libraries that work without a display.
_HEADLESS_LIBRARIES = ("egl", "osmesa")

_INSTALL_HINT = (
    "To render without a display, install an EGL library and a driver "
    "(`apt-get install libegl1 libgl1 libgl1-mesa-dri`), or install libosmesa6 "
    "(`apt-get install libosmesa6`) and set MUJOCO_GL=osmesa."
)

# PyOpenGL's error without EGL: it looks up the function in a library that is None.
_NO_EGL = "object has no attribute 'eglQueryString'"

# Error of MuJoCo's renderer without a graphics library.
_NO_CONTEXT = "has no attribute 'GLContext'"

# Color of the sky at the zenith, in [0, 1]; it fades to the haze of the model at the horizon.
_ZENITH = (0.35, 0.52, 0.70)

# Minimum half width of the square with sunlight shadows, around the target (m).
_MIN_SHADOW_RANGE = 2.0
_SUN_HEIGHT = 3.0


class OffscreenRenderer:
    """Renders `cfg.env_idx` and its `cfg.max_extra_envs` nearest neighbors into an image.

    The renderer uses a private copy of the model with extent `max(4, 1.5 distance)`, so that
    clipping planes and shadows do not depend on the environment spacing.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        cfg: ViewerConfig,
        scene: Scene,
        sim_model: Any | None = None,
        expanded_fields: set[str] | None = None,
    ) -> None:
        """Prepare the model and camera. `initialize` opens the graphics context.

        Args:
            model: Compiled scene.
            cfg: Camera, image size and visibility.
            scene: Scene, for its entities and environment origins (num_envs, 3).
            sim_model: Batched model, to render the randomized fields of each environment. Unused
                if `update` gets a `Simulation`, because that provides its model.
            expanded_fields: Names of the per-environment fields of `sim_model`.

        Raises:
            ValueError: `max_extra_envs` < 0, width or height < 1, or the camera's entity or body
                does not exist.
        """
        check_count("viewer.max_extra_envs", cfg.max_extra_envs, minimum=0)
        check_count("viewer.width", cfg.width)
        check_count("viewer.height", cfg.height)
        # Color and depth.
        check_memory("pixels of an image", cfg.width * cfg.height, 7, "cpu", "a smaller image")
        self._cfg = cfg
        self._scene = scene
        self._sim_model = sim_model
        self._expanded_fields = expanded_fields if expanded_fields is not None else set()
        self._view = resolve_camera(cfg, model, scene.entities)
        self._has_sky = has_sky(model)
        self._model = host_model(model)
        self._model.stat.extent = max(_MIN_EXTENT, 1.5 * cfg.distance)
        prepare_sun(self._model, cfg.distance)
        visual = self._model.vis
        if self._view.fovy is not None:
            visual.global_.fovy = self._view.fovy
        visual.global_.offwidth = max(visual.global_.offwidth, cfg.width)
        visual.global_.offheight = max(visual.global_.offheight, cfg.height)
        # On a CPU, a shadow map much finer than the image dominates the rendering time.
        max_shadow_size = 1 << int(np.ceil(np.log2(2 * max(cfg.width, cfg.height))))
        visual.quality.shadowsize = min(visual.quality.shadowsize, max_shadow_size)
        self._data = mujoco.MjData(self._model)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = cfg.geom_group
        self._option.sitegroup[:] = cfg.site_group
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
            raise WrongStateError("The offscreen renderer is not open; call initialize() first.")
        return self._renderer

    def initialize(self) -> None:
        """Open the graphics context.

        Raises:
            RuntimeError: The context is already open.
            RenderingUnavailableError: This machine cannot render; the message names the packages
                to install.
        """
        if self._renderer is not None:
            raise WrongStateError("The offscreen renderer is already open; call close() first.")
        self._renderer = open_renderer(self._model, self._cfg.height, self._cfg.width)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._cfg.enable_shadows
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._cfg.enable_reflections
        self._visualizer = MujocoNativeDebugVisualizer(self._renderer.scene, self._model)
        # Before the graphics library ends: MuJoCo's destructors print errors after it.
        atexit.register(_close_open, weakref.ref(self))

    def update(
        self,
        data: Any,
        debug_vis_callback: Callable[[MujocoNativeDebugVisualizer], None] | None = None,
        camera: str | int | None = None,
        env_idx: int | None = None,
    ) -> None:
        """Update the scene to the current state.

        Args:
            data: A `Simulation`, its `data`, or a plain `MjData`.
            debug_vis_callback: Called with a visualizer for the primary environment.
            camera: Name or ID of a model camera to use instead of the configured view.
            env_idx: Environment to show without neighbors. None: those of the config.

        Raises:
            RuntimeError: `initialize` has not been called.
            KeyError: Unknown camera; the message suggests close names.
        """
        scene = self.renderer.scene
        origins = self._scene.env_origins
        is_alone = env_idx is not None
        if env_idx is None:
            env_idx = min(max(self._cfg.env_idx, 0), len(origins) - 1)
        self._load(data, env_idx)
        move_sun(self._model, self._data, self._view.target(self._data.xpos))
        self._view.apply(self._camera, self._data.xpos)
        shown = self._camera if camera is None else self._camera_id(camera)
        self.renderer.update_scene(self._data, camera=shown, scene_option=self._option)
        if debug_vis_callback is not None and self._visualizer is not None:
            self._visualizer.begin(env_idx, show_all_envs=False)
            debug_vis_callback(self._visualizer)
        if self._extra_envs is None:
            # Choose neighbors once: terrain curricula move origins, and neighbors would flicker.
            self._extra_envs = nearest_envs(to_numpy(origins), env_idx, self._cfg.max_extra_envs)
        for extra in () if is_alone else self._extra_envs:
            self._load(data, extra)
            add_moving_geoms(scene, self._model, self._data, self._option)

    def render(self) -> np.ndarray:
        """Return the image of the last `update`, rows from the top, uint8, (height, width, 3).

        Raises:
            RuntimeError: `initialize` has not been called.
        """
        pixels = self.renderer.render()
        if not self._has_sky:
            paint_sky(pixels, self.renderer)
        return pixels

    def close(self) -> None:
        """Close the graphics context. Repeated calls have no effect; `initialize` may follow."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
            self._visualizer = None

    def _camera_id(self, camera: str | int) -> int:
        names = [self._model.camera(i).name for i in range(self._model.ncam)]
        if camera in range(len(names)):
            return int(camera)
        check_exists("camera", str(camera), names, UnknownNameError)
        return names.index(str(camera))

    def _load(self, data: Any, env_idx: int) -> None:
        # Read from the simulation at every frame: fields may have been expanded since the last.
        model = getattr(data, "model", self._sim_model)
        fields = getattr(data, "expanded_fields", self._expanded_fields)
        if model is not None and fields:
            sync_model_fields(self._model, model, fields, env_idx)
        copy_state(data, env_idx, self._data)
        compute_poses(self._model, self._data)


def _close_open(reference: weakref.ref[OffscreenRenderer]) -> None:
    if (renderer := reference()) is not None:
        renderer.close()


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """Return a renderer for images of (height, width) pixels.

    MuJoCo selects its graphics library on import. A program that imports it before mjlab gets one
    that needs a display; this function still uses the library named by MUJOCO_GL (on Linux, egl if
    unset).

    Raises:
        RenderingUnavailableError: This machine cannot render, or not at that size; the message says
            what to install or change.
    """
    # If a library is missing, PyOpenGL and MuJoCo raise a dozen error types (ImportError,
    # AttributeError, FatalError, ...), some of them on import. All have the same cause.
    try:
        return _open(model, height, width)
    except Exception as error:
        failure = error
    # A tiny image tells a machine that cannot render from an image that is too large.
    try:
        small = _open(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    except Exception:
        raise RenderingUnavailableError.offscreen(failure) from failure
    limit_hint = ""
    with closing(small), suppress(Exception):
        from OpenGL import GL

        limit = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
        limit_hint = f" Its limit is {limit} x {limit}, if memory allows."
    reason = " ".join(str(failure).split())
    raise RenderingUnavailableError(
        f"The graphics library of this machine cannot render an image of {width} x {height} pixels "
        f"({reason}).{limit_hint} Use a smaller size (of clips: --video-width, --video-height)."
    ) from failure


def _open(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    library = os.environ.get("MUJOCO_GL", "").lower() or "egl"
    if sys.platform == "linux" and library in _HEADLESS_LIBRARIES:
        from mujoco.rendering.classic import gl_context

        context = importlib.import_module(f"mujoco.{library}").GLContext
        if getattr(gl_context, "GLContext", None) is not context:
            # MuJoCo reads the variable when it imports gl_context.
            os.environ["MUJOCO_GL"] = library
            importlib.reload(gl_context)
    return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)


class RenderingUnavailableError(MjlabError, RuntimeError):
    """Image or window requested on a machine that cannot render.

    The message is one line with the failure and the packages to install, so that a caller can
    continue without images: `except RenderingUnavailableError as error: log.warning("%s", error)`.
    """

    @classmethod
    def offscreen(cls, cause: BaseException | str) -> RenderingUnavailableError:
        """Return the error for a failure to create an OpenGL context."""
        if graphics.problem is not None:
            return cls(f"Cannot render offscreen: {graphics.problem}. {_INSTALL_HINT}")
        backend = os.environ.get("MUJOCO_GL") or "unset"
        reason = " ".join(str(cause).split()) or type(cause).__name__
        if _NO_EGL in reason:
            reason = "no EGL library or driver was found"
        elif _NO_CONTEXT in reason:
            reason = "the variable disables rendering"
        return cls(
            f"Cannot render offscreen (MUJOCO_GL={backend}): {reason.rstrip('.')}. {_INSTALL_HINT}"
        )


def has_sky(model: mujoco.MjModel) -> bool:
    """Return True if the model has a skybox."""
    return bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any())


def paint_sky(pixels: np.ndarray, renderer: mujoco.Renderer) -> None:
    """Paint a sky into the empty pixels of the image last drawn by `renderer`.

    Args:
        pixels: Image, written in place, rows from the top, uint8, (height, width, 3).
        renderer: Renderer with the image in its buffers.
    """
    depth = np.empty(pixels.shape[:2], dtype=np.float32)
    context = renderer._mjr_context
    mujoco.mjr_readPixels(None, depth, renderer._rect, context)
    # Rows of the depth buffer start at the bottom.
    zero_far = context.readDepthMap == mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    empty = depth[::-1] == (0.0 if zero_far else 1.0)
    rows = np.flatnonzero(empty.any(axis=1))
    if len(rows) == 0:
        return
    horizon = np.asarray(renderer.model.vis.rgba.haze[:3], dtype=float)
    share = np.linspace(0.0, 1.0, rows[-1] + 1)[:, None]
    colors = (1.0 - share) * np.array(_ZENITH) + share * horizon
    sky = np.zeros((len(pixels), 1, 3), dtype=np.uint8)
    sky[: rows[-1] + 1, 0] = np.round(255.0 * colors)
    # Transparent geoms, such as ghosts, are blended over black and are not in the depth buffer.
    # Their opacity is lost; assume that of ghosts, 0.5.
    through = empty & pixels.any(axis=2)
    tinted = np.minimum(pixels.astype(np.uint16) + sky // 2, 255)
    np.copyto(pixels, sky, where=(empty & ~through)[:, :, None])
    np.copyto(pixels, tinted.astype(np.uint8), where=through[:, :, None])


def prepare_sun(model: mujoco.MjModel, distance: float) -> None:
    """Merge directional lights into one sun with sharp shadows near the camera's target.

    A ground plane and a terrain grid add a light each, and two lights overexpose the image.

    Args:
        model: Private copy of the model, with its extent set.
        distance: Distance from the camera to its target (m).
    """
    suns = np.flatnonzero(model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    model.light_diffuse[suns] /= max(len(suns), 1)
    model.light_castshadow[suns[1:]] = False
    model.vis.map.shadowclip = max(_MIN_SHADOW_RANGE, distance) / model.stat.extent


def move_sun(model: mujoco.MjModel, data: mujoco.MjData, target: np.ndarray) -> None:
    """Place directional lights over `target` (3,), so that its shadow follows it.

    The position of a directional light only determines the area with shadows.
    """
    suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    data.light_xpos[suns] = target - _SUN_HEIGHT * data.light_xdir[suns]
