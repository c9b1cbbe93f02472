"""Whether this machine has a display to open a window on."""

from __future__ import annotations

import os
import sys

from mjlab.viewer.errors import RenderingUnavailableError


def require_display() -> None:
    """Check that a window can be opened.

    Raises:
        RenderingUnavailableError: There is no display. (GLFW itself would end the program.)
    """
    if sys.platform != "linux":
        return
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderingUnavailableError(
            "MuJoCo's window needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set. "
            "Use the browser viewer instead (--viewer viser)."
        )
    import glfw

    if not glfw.init():
        raise RenderingUnavailableError(
            f"MuJoCo's window cannot open on DISPLAY={os.environ.get('DISPLAY')!r}: the display "
            "server does not answer. Use the browser viewer instead (--viewer viser)."
        )
