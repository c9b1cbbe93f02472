"""MuJoCo's graphics library, chosen before MuJoCo is imported.

`MUJOCO_GL` names it. With one that MuJoCo does not know, or that is not installed, `import mujoco` fails,
also in programs that draw nothing: it is switched off then, and rendering says why.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys

_VARIABLE = "MUJOCO_GL"
_OFF = "disable"
_ANYWHERE = ("", "glfw", "enable", "enabled", "on", "true", "1")
_SWITCHED_OFF = (_OFF, "disabled", "off", "false", "0")
_OF_PLATFORM = {"linux": ("glx", "egl", "osmesa"), "win32": ("wgl",), "darwin": ("cgl",)}

problem: str | None = None
"""Value of `MUJOCO_GL` that cannot be used, and why; None if there is nothing to say."""


def choose_graphics_library() -> None:
    """Set `MUJOCO_GL` to `egl` on Linux if it is not set and EGL is installed; to `disable` if unusable."""
    global problem
    if "mujoco" in sys.modules:
        return
    if _VARIABLE not in os.environ:
        if sys.platform == "linux" and _has_egl():
            os.environ[_VARIABLE] = "egl"
        return
    given = os.environ[_VARIABLE]
    value = given.lower().strip()
    known = (*_ANYWHERE, *_SWITCHED_OFF, *_OF_PLATFORM.get(sys.platform, ()))
    if value not in known:
        options = ", ".join(("glfw", *_OF_PLATFORM.get(sys.platform, ()), _OFF))
        problem = f"{_VARIABLE}={given} is unknown to MuJoCo; unset it, or choose from {options}"
    elif (value == "egl" and not _has_egl()) or (
        # As PyOpenGL looks for it.
        value == "osmesa" and ctypes.util.find_library("OSMesa") is None
    ):
        problem = f"{_VARIABLE}={given}, and that library is not installed"
    else:
        return
    os.environ[_VARIABLE] = _OFF


def _has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True
