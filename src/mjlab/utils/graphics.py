"""Selection of MuJoCo's graphics library, before MuJoCo is imported.

The variable `MUJOCO_GL` names the library. If the library is unknown or not installed, `import mujoco`
fails, even in programs without rendering. So an unusable value is replaced by `disable`, and rendering
reports the reason.
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
"""Unusable value of `MUJOCO_GL` with the reason; None if the value is usable."""


def choose_graphics_library() -> None:
    """Set `MUJOCO_GL` to `egl` on Linux if unset and EGL is installed; to `disable` if unusable."""
    global problem
    if "mujoco" in sys.modules:
        return
    if _VARIABLE not in os.environ:
        if sys.platform == "linux" and _has_egl():
            os.environ[_VARIABLE] = "egl"
        return
    setting = os.environ[_VARIABLE]
    value = setting.lower().strip()
    known = (*_ANYWHERE, *_SWITCHED_OFF, *_OF_PLATFORM.get(sys.platform, ()))
    if value not in known:
        options = ", ".join(("glfw", *_OF_PLATFORM.get(sys.platform, ()), _OFF))
        problem = f"{_VARIABLE}={setting} is unknown to MuJoCo; unset it, or choose from {options}"
    elif not _is_installed(value):
        problem = f"{_VARIABLE}={setting}, but this library is not installed"
    else:
        return
    os.environ[_VARIABLE] = _OFF


def _is_installed(value: str) -> bool:
    """Return False if `MUJOCO_GL` names a library that is known to be missing."""
    if value == "osmesa":
        # Same lookup as in PyOpenGL.
        return ctypes.util.find_library("OSMesa") is not None
    return value != "egl" or _has_egl()


def _has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True
