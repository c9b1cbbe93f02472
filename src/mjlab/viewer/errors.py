"""The one error that says: this machine cannot draw."""

from __future__ import annotations

import os

from mjlab.utils import graphics

_INSTALL_HINT = (
    "To render without a display, install an EGL library and a driver "
    "(`apt-get install libegl1 libgl1 libgl1-mesa-dri`), or install libosmesa6 "
    "(`apt-get install libosmesa6`) and set MUJOCO_GL=osmesa."
)
# How PyOpenGL fails where there is no EGL: it looks for the function in a library that is None.
_NO_EGL = "object has no attribute 'eglQueryString'"
# How MuJoCo's renderer fails without a graphics library.
_NO_CONTEXT = "has no attribute 'GLContext'"


class RenderingUnavailableError(RuntimeError):
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
