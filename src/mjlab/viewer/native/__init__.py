"""Native viewer: MuJoCo's window, and debug drawing into MuJoCo scenes.

The window is imported on first use: the offscreen renderer only needs the debug drawing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.viewer.native.viewer import NativeMujocoViewer as NativeMujocoViewer
    from mjlab.viewer.native.visualizer import (
        MujocoNativeDebugVisualizer as MujocoNativeDebugVisualizer,
    )

_HOMES = {
    "MujocoNativeDebugVisualizer": "mjlab.viewer.native.visualizer",
    "NativeMujocoViewer": "mjlab.viewer.native.viewer",
}

__all__ = sorted(_HOMES)

__getattr__ = lazy_names(__name__, _HOMES)
