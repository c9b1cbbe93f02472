"""GPU synchronization, count of host waits, and memory use."""

from __future__ import annotations

import contextlib
import gc
import math
import warnings
from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import warp

wp: Any = warp

_SYNCHRONIZING = "called a synchronizing CUDA operation"
_MIB = 2**20


def wait(device: str) -> None:
    """Synchronize the device. No-op on the CPU."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


@dataclass
class Waits:
    """Count of torch operations that synchronize with the GPU."""

    places: Counter[str] = field(default_factory=Counter)
    """Number of host synchronizations by `file:line`."""
    is_known: bool = True
    """False on the CPU: torch does not report them."""

    def per_step(self, steps: int) -> str:
        """Return the number per step, and the lines with the most waits."""
        if not self.is_known:
            return "-"
        most = ", ".join(f"{place} {n / steps:.2g}" for place, n in self.places.most_common(6))
        return f"{self.places.total() / steps:.1f}" + (f" ({most})" if most else "")


@contextlib.contextmanager
def counted_waits(device: str) -> Generator[Waits]:
    """Count torch operations that synchronize with the GPU within the block."""
    waits = Waits(is_known=device.startswith("cuda"))
    if not waits.is_known:
        yield waits
        return
    wait(device)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield waits
        finally:
            torch.cuda.set_sync_debug_mode("default")
    for warning in caught:
        if _SYNCHRONIZING in str(warning.message):
            waits.places[f"{Path(warning.filename).name}:{warning.lineno}"] += 1


class Memory:
    """GPU memory used since construction (MiB). None: CPU."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._before = self._used()

    def taken(self) -> dict[str, float] | None:
        """Return the memory held by torch and Warp, and the decrease of free device memory."""
        if self._before is None:
            return None
        now = self._used()
        assert now is not None
        return {name: (now[name] - before) / _MIB for name, before in self._before.items()}

    def shown(self) -> str:
        """Return `taken` as text."""
        taken = self.taken()
        if taken is None:
            return "-"
        parts = ", ".join(f"{name} {taken[name]:,.0f}" for name in ("torch", "warp"))
        return f"{taken['device']:,.0f} MiB ({parts})"

    def _used(self) -> dict[str, float] | None:
        if not self._device.startswith("cuda"):
            return None
        gc.collect()
        wait(self._device)
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(self._device)
        device = wp.get_device(self._device)
        return {
            "device": total - free,
            "torch": torch.cuda.memory_allocated(self._device),
            # Without a memory pool, Warp reports no usage.
            "warp": wp.get_mempool_used_mem_current(device)
            if device.is_mempool_supported
            else math.nan,
        }
