"""Robot learning from small composable pieces, on MuJoCo's CPU threads or on NVIDIA GPUs.

Importing this package does one thing beyond defining names: on Linux, where the EGL library is
installed and the variable is not set already, it sets `MUJOCO_GL=egl`, so that MuJoCo renders
without a display. A library in that variable that MuJoCo could not be imported with is switched off.
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
    # The command-line flags are made on demand, because importing tyro costs time that
    # `import mjlab` should not.
    if name == "TYRO_FLAGS":
        import tyro

        return (
            tyro.conf.AvoidSubcommands,
            tyro.conf.FlagConversionOff,
            tyro.conf.UsePythonSyntaxForLiteralCollections,
        )
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
