"""Questions to a GPU: has it finished, how often did the host wait for it, how much memory is taken."""

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
    """Wait until the device has done all its work; nothing on the CPU, which never lags behind."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


@dataclass
class Waits:
    """Operations of torch that made the host wait for the GPU."""

    places: Counter[str] = field(default_factory=Counter)
    """Number of host synchronizations by `file:line`."""
    is_known: bool = True
    """False on the CPU, where torch does not tell."""

    def per_step(self, steps: int) -> str:
        """Return the number of a step, and the places that wait most."""
        if not self.is_known:
            return "-"
        most = ", ".join(f"{place} {n / steps:.2g}" for place, n in self.places.most_common(6))
        return f"{self.places.total() / steps:.1f}" + (f" ({most})" if most else "")


@contextlib.contextmanager
def counted_waits(device: str) -> Generator[Waits]:
    """Count, within the block, the operations of torch that wait for the GPU."""
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
    """GPU memory taken since this was made, in MiB; None on the CPU."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._before = self._used()

    def taken(self) -> dict[str, float] | None:
        """Return what torch and Warp hold now, and what the device has less."""
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
            # Without a memory pool, Warp does not know.
            "warp": wp.get_mempool_used_mem_current(device)
            if device.is_mempool_supported
            else math.nan,
        }
