"""Choice of GPUs."""

from __future__ import annotations

import logging
import os
from typing import Literal

logger = logging.getLogger(__name__)


def select_gpus(
    gpu_ids: list[int] | Literal["all"] | None,
) -> tuple[list[int | str] | None, int]:
    """Return the devices for `CUDA_VISIBLE_DEVICES`, and their number; (None, 0) means the CPU.

    Args:
        gpu_ids: Positions among the GPUs this process may see, which are the entries of
            `CUDA_VISIBLE_DEVICES` (numbers, or strings as for MIG devices) if it is set, else all
            of the machine. "all" takes every one, None none.

    Where there is no GPU the result is the CPU, whatever was asked for. Raises `ValueError`,
    naming the valid positions, for one out of range.
    """
    if gpu_ids is None:
        return None, 0
    available = _available_devices()
    if not available:
        logger.info("No GPU is visible; using the CPU.")
        return None, 0
    if gpu_ids == "all":
        return available, len(available)
    invalid = [index for index in gpu_ids if not 0 <= index < len(available)]
    if invalid:
        raise ValueError(
            f"There is no GPU {invalid}: valid indices are {list(range(len(available)))} "
            f"(the visible GPUs {available})."
        )
    if not gpu_ids:
        return None, 0
    return [available[index] for index in gpu_ids], len(gpu_ids)


def egl_device_id(index: int) -> int | None:
    """Return the number that EGL has for the GPU which torch calls `cuda:<index>`.

    EGL numbers all GPUs of the machine, whichever are visible to CUDA. None where it cannot be told:
    for an index out of range, and for GPUs that are named by strings, as MIG devices are.
    """
    available = _available_devices()
    device = available[index] if 0 <= index < len(available) else None
    return device if isinstance(device, int) else None


def _available_devices() -> list[int | str]:
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        import torch

        return list(range(torch.cuda.device_count()))
    devices: list[int | str] = []
    for entry in (part.strip() for part in visible.split(",")):
        # CUDA sees no device from the first one that is not valid, -1 by custom.
        if entry in ("", "-1"):
            break
        devices.append(int(entry) if entry.isdigit() else entry)
    return devices
