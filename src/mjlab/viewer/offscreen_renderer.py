"""Images of one environment and its neighbours, drawn without a window.

`OffscreenRenderer` draws environments, `open_renderer` opens MuJoCo's renderer for any model. A machine
that cannot draw raises `RenderingUnavailableError`. Models without a sky get one painted, and their
directional lights become one sun that follows the camera.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.utils import graphics
from mjlab.utils.errors import MjlabError, WrongStateError, check_count
from mjlab.utils.string import suggest
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

# Graphics libraries that need no display.
_WITHOUT_DISPLAY = ("egl", "osmesa")

_INSTALL_HINT = (
    "To render without a display, install an EGL library and a driver "
    "(`apt-get install libegl1 libgl1 libgl1-mesa-dri`), or install libosmesa6 "
    "(`apt-get install libosmesa6`) and set MUJOCO_GL=osmesa."
)

# How PyOpenGL fails where there is no EGL: it looks for the function in a library that is None.
_NO_EGL = "object has no attribute 'eglQueryString'"

# How MuJoCo's renderer fails without a graphics library.
_NO_CONTEXT = "has no attribute 'GLContext'"

# The sky above, as a colour in [0, 1]; towards the horizon it becomes the haze of the model.
_ZENITH = (0.35, 0.52, 0.70)

# Least half width, in metres, of the square around the target in which sunlight casts shadows.
_MIN_SHADOW_RANGE = 2.0
_SUN_HEIGHT = 3.0


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
        check_count("viewer.max_extra_envs", cfg.max_extra_envs, minimum=0)
        check_count("viewer.width", cfg.width)
        check_count("viewer.height", cfg.height)
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
        # A shadow map much finer than the image costs most of the drawing time where a CPU draws.
        finest = 1 << int(np.ceil(np.log2(2 * max(cfg.width, cfg.height))))
        visual.quality.shadowsize = min(visual.quality.shadowsize, finest)
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
            RuntimeError: It is open already.
            RenderingUnavailableError: This machine cannot render; the text says what to install.
        """
        if self._renderer is not None:
            raise WrongStateError("The offscreen renderer is open already; call close() first.")
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
        origins = self._scene.env_origins
        env_idx = min(max(self._cfg.env_idx, 0), len(origins) - 1)
        self._load(data, env_idx)
        move_sun(self._model, self._data, self._view.target(self._data.xpos))
        self.renderer.update_scene(
            self._data, camera=self._camera_for(camera), scene_option=self._option
        )
        if debug_vis_callback is not None and self._visualizer is not None:
            self._visualizer.begin(env_idx, show_all_envs=False)
            debug_vis_callback(self._visualizer)
        if self._extra_envs is None:
            # Chosen once: terrain curricula move origins, and neighbours should not flicker.
            self._extra_envs = nearest_envs(to_numpy(origins), env_idx, self._cfg.max_extra_envs)
        for extra in self._extra_envs:
            self._load(data, extra)
            add_moving_geoms(scene, self._model, self._data, self._option)

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
        raise ValueError(f"Unknown camera {name!r}; {suggest(str(name), names)}")


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """A renderer for images of (height, width) pixels.

    MuJoCo chooses its graphics library when it is imported. A program that imports it before
    mjlab gets one that needs a display; the library named by MUJOCO_GL (on Linux, egl where that
    is not set) is used here all the same.

    Raises:
        RenderingUnavailableError: No image can be drawn, or none of that size; the text says what to
            install or change.
    """
    # Where a library is missing, PyOpenGL and MuJoCo fail in a dozen ways (ImportError,
    # AttributeError, FatalError, ...), some of them while being imported. All mean the same.
    try:
        return _open(model, height, width)
    except Exception as error:
        failure = error
    # Is it the machine, or the size?
    try:
        small = _open(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    except Exception:
        raise RenderingUnavailableError.offscreen(failure) from failure
    try:
        from OpenGL import GL

        limit = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
        most = f" It draws at most {limit} x {limit}, if the memory is enough."
    except Exception:
        most = ""
    finally:
        small.close()
    reason = " ".join(str(failure).split())
    raise RenderingUnavailableError(
        f"The graphics library of this machine cannot draw an image of {width} x {height} pixels "
        f"({reason}).{most} Choose a smaller width or height; those of clips are "
        "--video-width and --video-height."
    ) from failure


def _open(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    library = os.environ.get("MUJOCO_GL", "").lower() or "egl"
    if sys.platform == "linux" and library in _WITHOUT_DISPLAY:
        from mujoco.rendering.classic import gl_context

        context = importlib.import_module(f"mujoco.{library}").GLContext
        if getattr(gl_context, "GLContext", None) is not context:
            # MuJoCo chooses by the variable when this module of it is loaded.
            os.environ["MUJOCO_GL"] = library
            importlib.reload(gl_context)
    return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)


class RenderingUnavailableError(MjlabError, RuntimeError):
    """Raised where an image or a window was asked for and this machine cannot draw one.

    Its text is one line that says what failed and what to install, so that a caller can go on
    without pictures: `except RenderingUnavailableError as error: log.warning("%s", error)`.
    """

    @classmethod
    def offscreen(cls, cause: BaseException | str) -> RenderingUnavailableError:
        """The error for an OpenGL context that could not be made, whatever the library said."""
        if graphics.problem is not None:
            return cls(f"Cannot render offscreen: {graphics.problem}. {_INSTALL_HINT}")
        backend = os.environ.get("MUJOCO_GL") or "unset"
        reason = " ".join(str(cause).split()) or type(cause).__name__
        if _NO_EGL in reason:
            reason = "no EGL library or driver was found"
        elif _NO_CONTEXT in reason:
            reason = "the variable switches rendering off"
        return cls(
            f"Cannot render offscreen (MUJOCO_GL={backend}): {reason.rstrip('.')}. {_INSTALL_HINT}"
        )


def has_sky(model: mujoco.MjModel) -> bool:
    """Whether the model brings a sky of its own."""
    return bool((model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any())


def paint_sky(pixels: np.ndarray, renderer: mujoco.Renderer) -> None:
    """Paint a sky where the image that `renderer` has just drawn shows nothing.

    Args:
        pixels: The image, (height, width, 3), uint8, rows from the top; written in place.
        renderer: The renderer, whose buffers still hold the image.
    """
    depth = np.empty(pixels.shape[:2], dtype=np.float32)
    context = renderer._mjr_context
    mujoco.mjr_readPixels(None, depth, renderer._rect, context)
    # The buffer is read from the bottom.
    zero_far = context.readDepthMap == mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    nothing = depth[::-1] == (0.0 if zero_far else 1.0)
    rows = np.flatnonzero(nothing.any(axis=1))
    if len(rows) == 0:
        return
    horizon = np.asarray(renderer.model.vis.rgba.haze[:3], dtype=float)
    share = np.linspace(0.0, 1.0, rows[-1] + 1)[:, None]
    colors = (1.0 - share) * np.array(_ZENITH) + share * horizon
    sky = np.zeros((len(pixels), 1, 3), dtype=np.uint8)
    sky[: rows[-1] + 1, 0] = np.round(255.0 * colors)
    # See-through shapes, such as ghosts, are drawn over black, and are not in the depths. How much of
    # what is behind they let through is not known any more; half is what ghosts do.
    through = nothing & pixels.any(axis=2)
    tinted = np.minimum(pixels.astype(np.uint16) + sky // 2, 255)
    np.copyto(pixels, sky, where=(nothing & ~through)[:, :, None])
    np.copyto(pixels, tinted.astype(np.uint8), where=through[:, :, None])


def prepare_sun(model: mujoco.MjModel, distance: float) -> None:
    """Make directional lights one sun, whose shadows are near the camera's target, and fine.

    A ground and a grid of terrain bring a light each, and under two everything would be white.

    Args:
        model: A private copy of the model, with its extent set.
        distance: Distance from the camera to its target, in metres.
    """
    suns = np.flatnonzero(_is_directional(model))
    model.light_diffuse[suns] /= max(len(suns), 1)
    model.light_castshadow[suns[1:]] = False
    model.vis.map.shadowclip = max(_MIN_SHADOW_RANGE, distance) / model.stat.extent


def move_sun(model: mujoco.MjModel, data: mujoco.MjData, target: np.ndarray) -> None:
    """Bring directional lights over `target` (3,), so that its shadow follows it.

    Where such a light stands only decides where it casts shadows.
    """
    suns = _is_directional(model)
    data.light_xpos[suns] = target - _SUN_HEIGHT * data.light_xdir[suns]


def _is_directional(model: mujoco.MjModel) -> np.ndarray:
    return model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
