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
        RenderingUnavailableError: No image can be drawn, or none of that size; the text says what to
            install or change.
    """
    # Where a library is missing, PyOpenGL and MuJoCo fail in a dozen ways (ImportError,
    # AttributeError, FatalError, ...), some of them while being imported. All mean the same.
    try:
        return _open(model, height, width)
    except Exception as error:
        raise _explained(error, height, width) from error


def _open(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    wanted = os.environ.get("MUJOCO_GL", "").lower() or "egl"
    if sys.platform != "linux" or wanted not in _WITHOUT_DISPLAY:
        return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)
    from mujoco.rendering.classic import gl_context

    context = importlib.import_module(f"mujoco.{wanted}").GLContext
    # MuJoCo has none if it was imported with MUJOCO_GL=disable.
    with mock.patch.object(gl_context, "GLContext", context, create=True):
        return mujoco.Renderer(model, height, width, max_geom=_MAX_GEOMS)


def _explained(error: Exception, height: int, width: int) -> RenderingUnavailableError:
    """Return the error for an image that cannot be drawn: is it the machine, or the size?"""
    try:
        small = _open(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
    except Exception:
        return RenderingUnavailableError.offscreen(error)
    try:
        from OpenGL import GL

        limit = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
        most = f" It draws at most {limit} x {limit}, if the memory is enough."
    except Exception:
        most = ""
    finally:
        small.close()
    reason = " ".join(str(error).split())
    return RenderingUnavailableError(
        f"The graphics library of this machine cannot draw an image of {width} x {height} pixels "
        f"({reason}).{most} Choose a smaller width or height; those of clips are "
        "--video-width and --video-height."
    )
