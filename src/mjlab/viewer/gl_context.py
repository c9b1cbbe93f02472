"""Opening MuJoCo's offscreen renderer with a graphics library that needs no display."""

from __future__ import annotations

import importlib
import os
import sys
from unittest import mock

import mujoco

from mjlab.viewer.errors import RenderingUnavailableError

_MAX_GEOMS = 10_000
_WITHOUT_DISPLAY = ("egl", "osmesa")


def open_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """A renderer for images of (height, width) pixels.

    MuJoCo chooses its graphics library when it is imported. A program that imports it before
    mjlab gets one that needs a display; the library named by MUJOCO_GL (on Linux, egl where that
    is not set) is used here all the same.

    Raises:
        RenderingUnavailableError: No image can be drawn; the text says what to install.
    """
    # Where a library is missing, PyOpenGL and MuJoCo fail in a dozen ways (ImportError,
    # AttributeError, FatalError, ...), some of them while being imported. All mean the same.
    try:
        wanted = os.environ.get("MUJOCO_GL", "").lower() or "egl"
        if sys.platform != "linux" or wanted not in _WITHOUT_DISPLAY:
            return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)
        from mujoco.rendering.classic import gl_context

        context = importlib.import_module(f"mujoco.{wanted}").GLContext
        with mock.patch.object(gl_context, "GLContext", context):
            return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)
    except Exception as error:
        raise RenderingUnavailableError.offscreen(error) from error
