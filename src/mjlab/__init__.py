"""Robot learning from small composable pieces, on MuJoCo's CPU threads or on NVIDIA GPUs.

Importing this package does one thing beyond defining names: on Linux, where the EGL library is
installed and the variable is not set already, it sets `MUJOCO_GL=egl`, so that MuJoCo renders
without a display.
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    TYRO_FLAGS: tuple[Any, ...]

MJLAB_SRC_PATH = Path(__file__).parent
"""Folder of this package."""


def _prefer_egl() -> None:
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ:
        return
    # With the variable set, `import mujoco` fails where the library is missing.
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return
    os.environ["MUJOCO_GL"] = "egl"


_prefer_egl()


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
