"""MuJoCo's own window, and drawing into MuJoCo scenes.

The window is loaded on first use: the offscreen renderer needs the drawing only.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
