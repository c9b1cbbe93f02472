"""Several processes that train one policy: joining them, and keeping them together.

Every process has environments and random numbers of its own. rsl_rl averages gradients, the
statistics of observation normalizers, and the policy change that the learning rate follows, so that
all processes hold the same networks after every update. The first process alone writes files.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Generator
from datetime import timedelta
from typing import TypeVar

import torch

from mjlab.utils.processes import ProcessRank, process_rank

T = TypeVar("T")

# Set by our launcher, as host:port; torchrun announces its store by MASTER_ADDR and MASTER_PORT.
STORE_VARIABLE = "MJLAB_PROCESS_STORE"

logger = logging.getLogger(__name__)

# Seconds after which a process says for whom it waits, and after which it gives up, as torch does.
_SECONDS_OF_SILENCE = 5.0
_SECONDS_TO_JOIN = 1800.0


class OtherProcessError(RuntimeError):
    """Another process of the run failed, and said why; this one cannot go on without it."""


def join_processes(device: str) -> bool:
    """Join the other processes of the run, which waits for them; return whether this call did.

    It does not where there are no others, or where they were joined before. Networks on a GPU are
    averaged by NCCL, those on the CPU, and everything that is no tensor on a GPU, by Gloo.

    Raises:
        ValueError: the environment variables of the launcher are contradictory.
        OSError: the address that they name cannot be listened on.
        TimeoutError: not all processes have come within half an hour.
    """
    rank = process_rank()
    if rank.is_alone or torch.distributed.is_initialized():
        return False
    backend = "gloo"
    if torch.device(device).type == "cuda":
        backend = "cpu:gloo,cuda:nccl"
        torch.cuda.set_device(torch.device(device))
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        # torchrun starts them all, and ends them where one is missing.
        torch.distributed.init_process_group(backend)
        return True
    torch.distributed.init_process_group(
        backend, store=_store_with_all(rank), rank=rank.rank, world_size=rank.world_size
    )
    return True


def _store_with_all(rank: ProcessRank) -> torch.distributed.Store:
    """Return the store in which processes find each other, once all of them have come."""
    address = os.environ.get(STORE_VARIABLE)
    host, port = os.environ.get("MASTER_ADDR"), os.environ.get("MASTER_PORT")
    if address is not None:
        host, _, port = address.rpartition(":")
    if not host or port is None or not port.isdigit():
        raise ValueError(
            f"WORLD_SIZE={rank.world_size}: expected MASTER_ADDR and MASTER_PORT, where processes find "
            f"each other, got {host!r} and {port!r}; use torchrun, or unset WORLD_SIZE."
        )
    hosts = rank.is_first and address is None
    begin, where = time.monotonic(), f"{host}:{port}"
    names = f"Process {rank.rank} of {rank.world_size}"
    hint = "WORLD_SIZE says how many there are; unset it to train in one process."
    # Looking for a store that is not there does not return.
    timer = threading.Timer(
        _SECONDS_OF_SILENCE,
        lambda: logger.warning("%s waits for process 0 at %s. %s", names, where, hint),
    )
    timer.daemon = True
    timer.start()
    try:
        store = torch.distributed.TCPStore(
            host,
            int(port),
            rank.world_size,
            is_master=hosts,
            timeout=timedelta(seconds=_SECONDS_TO_JOIN),
            wait_for_workers=False,
        )
    except torch.distributed.DistError as error:
        if hosts:
            raise OSError(
                f"MASTER_ADDR, MASTER_PORT: expected an address that {names} can listen on, got "
                f"{where}; use another port."
            ) from error
        raise TimeoutError(f"{names} found no process 0 at {where}. {hint}") from error
    finally:
        timer.cancel()
    come, told = store.add("mjlab/come", 1), False
    while come < rank.world_size:
        waited = time.monotonic() - begin
        progress = f"at {where}: {come} of {rank.world_size} have come"
        if waited > _SECONDS_TO_JOIN:
            raise TimeoutError(f"{names} waited {waited:.0f} s for the others {progress}. {hint}")
        if waited > _SECONDS_OF_SILENCE and not told:
            logger.warning("%s waits for the others %s. %s", names, progress, hint)
            told = True
        time.sleep(0.05)
        come = store.add("mjlab/come", 0)
    return store


@contextlib.contextmanager
def joined_processes(device: str) -> Generator[ProcessRank]:
    """Be one of the processes of the run within the block.

    Raises:
        OtherProcessError: another process of the run ended within the block.
    """
    joined = join_processes(device)
    try:
        yield process_rank()
    except RuntimeError as error:
        if torch.distributed.is_initialized() and _is_lost_connection(error):
            raise OtherProcessError(
                "Another process of this run ended; what it printed says why."
            ) from error
        raise
    if joined:
        # Not after an error: the others may be gone, and this would wait for them.
        torch.distributed.destroy_process_group()


def _is_lost_connection(error: RuntimeError) -> bool:
    # Gloo raises plain errors, in which its name is part of the place in its source.
    return isinstance(error, torch.distributed.DistError) or "gloo" in str(error).lower()


def from_first(make: Callable[[], T]) -> T:
    """Return, in every process, what `make` returns in the first, which alone calls it.

    Raises:
        Exception: in the first process, what `make` raises.
        OtherProcessError: in the others, if it raised.
    """
    if not torch.distributed.is_initialized():
        return make()
    box: list[T | None] = [None]
    with same_fate():
        if process_rank().is_first:
            box[0] = make()
    torch.distributed.broadcast_object_list(box, src=0)
    return box[0]  # ty: ignore[invalid-explicit-return]


@contextlib.contextmanager
def same_fate() -> Generator[None]:
    """Wait at the end of the block for all processes; if it failed in any, it fails in all.

    Raises:
        Exception: in the first process that failed, its own error.
        OtherProcessError: in all others.
    """
    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    if not torch.distributed.is_initialized():
        if error is not None:
            raise error
        return
    failures: list[str | None] = [None] * process_rank().world_size
    failure = None if error is None else f"{type(error).__name__}: {error}"
    torch.distributed.all_gather_object(failures, failure)
    failed = [rank for rank, text in enumerate(failures) if text is not None]
    if not failed:
        return
    if failed[0] == process_rank().rank and error is not None:
        raise error
    raise OtherProcessError(f"Process {failed[0]} of this run failed: {failures[failed[0]]}")
