"""Machine, GPU and library versions of a measurement."""

from __future__ import annotations

import contextlib
import platform
import subprocess
import time
from typing import Any

import mujoco
import mujoco_warp
import torch
import warp

from mjlab.utils.processes import available_cores


def described(device: str) -> dict[str, Any]:
    """Return machine, GPU and library versions."""
    found: dict[str, Any] = {
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "device": device,
        "cores": available_cores(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": warp.__version__,
        "mujoco": mujoco.__version__,
        "mujoco_warp": getattr(mujoco_warp, "__version__", "?"),
    }
    if device.startswith("cuda"):
        if not torch.cuda.is_available():
            raise RuntimeError(
                f"PyTorch {torch.__version__} finds no CUDA here, and the device is {device}. "
                "Install the driver and a PyTorch with CUDA, or give --device cpu --tiny."
            )
        properties: Any = torch.cuda.get_device_properties(device)
        found["gpu"] = f"{properties.name} ({properties.total_memory / 2**30:.0f} GiB)"
        found["driver"] = _driver()
    return found


def _driver() -> str:
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
        return done.stdout.strip().partition("\n")[0] or "?"
    return "?"
