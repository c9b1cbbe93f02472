"""Memory check: sizes that the user sets against the machine's memory, before anything is allocated."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterator
from contextlib import suppress
from decimal import Decimal
from pathlib import Path

import torch

from mjlab.utils.processes import control_groups, process_rank

# Sizes that need no check (bytes): reading the limits takes 1 ms.
_SMALL = 2**24
_PROCESS = Path("/proc")
# Files with limit and usage (bytes) by version of control groups, and prefix of `memory.stat`.
_GROUP_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_"),
    2: ("memory.max", "memory.current", ""),
}


def check_memory(
    name: str,
    count: int,
    bytes_each: int,
    device: str,
    cure: str,
    *,
    usual: float = 1.0,
    warns: bool = True,
) -> bool:
    """Raise `ValueError` if `count` items of at least `bytes_each` bytes exceed all memory of `device`.

    `bytes_each` is a lower bound, so sizes that run pass. Warn if `usual` times as much exceeds the
    memory available now. Memory that the system does not report is unlimited.

    Args:
        name: Owner and field of `count`.
        count: Number of items.
        bytes_each: Lower bound on the memory of an item (bytes).
        device: Torch device that holds the items.
        cure: End of the message, after "use".
        usual: Usual memory of an item over `bytes_each`.
        warns: Warn, rather than only return.

    Returns:
        True if the items fit into the available memory.
    """
    needed = count * bytes_each
    if needed <= _SMALL or not (limits := list(_limits(device))):
        return True
    total, available = (min(sizes) for sizes in zip(*limits, strict=True))
    if needed > total:
        raise ValueError(
            f"{name}: expected at most {total // bytes_each:,} ({_gigabytes(total)} of memory on {device}), "
            f"got {count:,} (at least {_gigabytes(needed)}); use {cure}."
        )
    # Integers beyond 1e308 are errors in products with floats; those above the total ended before.
    fits = needed * usual <= available
    if warns and not fits:
        warnings.warn(
            f"{name}: expected about {max(available, 0) // int(usual * bytes_each):,} "
            f"({_gigabytes(available)} of memory available on {device}), got {count:,} (about "
            f"{_gigabytes(int(needed * usual))}); use {cure}, or memory runs out.",
            UserWarning,
            stacklevel=3,
        )
    return fits


def _limits(device: str) -> Iterator[tuple[int, int]]:
    """Yield total and available memory (bytes) of each limit on this process.

    Those of the CPU are the machine and the control groups, both with swap space and shared equally
    by the processes of the run on this machine, and the address space (`ulimit -v`).
    """
    kind = torch.device(device).type
    # Tensors on the meta device have no values.
    if kind == "meta":
        return
    if kind == "cuda":
        # A device that torch cannot use raises later, where it is used.
        with suppress(RuntimeError, AssertionError):
            free, total = torch.cuda.mem_get_info(device)
            unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
            yield total, free + unused
        return
    share, swap, free_swap = process_rank().local_world_size, 0, 0
    with suppress(OSError, ValueError, KeyError):
        sizes = _numbers(_PROCESS / "meminfo", 1024)
        swap, free_swap = sizes.get("SwapTotal:", 0), sizes.get("SwapFree:", 0)
        yield (sizes["MemTotal:"] + swap) // share, (sizes["MemAvailable:"] + free_swap) // share
    for group, version in control_groups("memory"):
        limit_file, usage_file, prefix = _GROUP_FILES[version]
        # Groups without a limit have the text "max".
        with suppress(OSError, ValueError, KeyError):
            limit = int((group / limit_file).read_text(encoding="utf-8"))
            used = int((group / usage_file).read_text(encoding="utf-8"))
            stat = _numbers(group / "memory.stat")
            # The system frees copies of files where memory is short.
            used -= stat[f"{prefix}active_file"] + stat[f"{prefix}inactive_file"]
            yield (limit + swap) // share, (limit - used + free_swap) // share
    with suppress(ImportError, OSError, ValueError, KeyError):
        resource = importlib.import_module("resource")
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            yield limit, limit - _numbers(_PROCESS / "self" / "status", 1024)["VmSize:"]


def _numbers(path: Path, unit: int = 1) -> dict[str, int]:
    """Return the second words of a file, as multiples of `unit`, by first words."""
    rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    return {row[0]: unit * int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def _gigabytes(size: int) -> str:
    return f"{Decimal(size).scaleb(-9):,.1f} GB"
