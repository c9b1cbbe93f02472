"""GPU selection."""

from __future__ import annotations

import os
from typing import Literal


def select_gpus(
    gpu_ids: list[int] | Literal["all"] | None,
) -> tuple[list[int | str] | None, int]:
    """Return the devices for `CUDA_VISIBLE_DEVICES` and their number; (None, 0) for the CPU.

    Args:
        gpu_ids: Indices into the visible GPUs (negative: from the end), or "all", or None for the
            CPU. Visible GPUs are the entries of `CUDA_VISIBLE_DEVICES` if set (numbers, or strings as
            for MIG devices), else all GPUs of the machine.

    Without a GPU, returns the CPU for any `gpu_ids`. Raises `ValueError`, listing the valid
    indices, for an index out of range.
    """
    if not gpu_ids:
        return None, 0
    available = _available_devices()
    if not available:
        return None, 0
    if gpu_ids == "all":
        return available, len(available)
    invalid = [index for index in gpu_ids if not -len(available) <= index < len(available)]
    if invalid:
        raise ValueError(
            f"Unknown GPU {invalid}. Available: {list(range(len(available)))} "
            f"(visible GPUs {available})."
        )
    return [available[index] for index in gpu_ids], len(gpu_ids)


def egl_device_id(index: int) -> int | None:
    """Return the EGL device number of torch's `cuda:<index>`.

    EGL numbers all GPUs of the machine, independent of CUDA visibility. Returns None for an index
    out of range and for GPUs identified by strings, such as MIG devices.
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
        # CUDA ignores the first invalid entry, usually -1, and all entries after it.
        if entry in ("", "-1"):
            break
        devices.append(int(entry) if entry.isdigit() else entry)
    return devices
