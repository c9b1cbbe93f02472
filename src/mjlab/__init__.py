"""Robot learning from small composable pieces, on MuJoCo's CPU threads or on NVIDIA GPUs.

Importing this package does one thing beyond defining names: on Linux, unless the variable is set
already, it sets `MUJOCO_GL=egl`, so that MuJoCo renders without a display.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    TYRO_FLAGS: tuple[Any, ...]

if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")


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
