"""Robot learning with MuJoCo, on CPU threads or NVIDIA GPUs.

Importing this package has one side effect: on Linux with the EGL library, it sets `MUJOCO_GL=egl` if
the variable is unset, so that MuJoCo renders without a display. If the variable names a library with
which MuJoCo cannot be imported, rendering is disabled.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.utils.graphics import choose_graphics_library

if TYPE_CHECKING:
    TYRO_FLAGS: tuple[Any, ...]

MJLAB_SRC_PATH = Path(__file__).parent
"""Folder of this package."""


choose_graphics_library()


def __getattr__(name: str) -> Any:
    # Command-line flags are created on demand, because importing tyro is slow.
    if name == "TYRO_FLAGS":
        import tyro

        return (
            tyro.conf.AvoidSubcommands,
            tyro.conf.FlagConversionOff,
            tyro.conf.UsePythonSyntaxForLiteralCollections,
        )
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
