"""Multi-process training of one policy: launcher, process group, collective error handling.

Every process has separate environments and random numbers. rsl_rl averages gradients, statistics of
observation normalizers, and the KL divergence that sets the learning rate, so that all processes hold
the same networks after every update. Only the first process writes files.

`launch_workers` replaces torch's launcher, which sends SIGTERM to all processes as soon as one ends
with an error: it may name a process that only lost its connection, and end the one that failed before
its error is printed. It also does not report the exit status of processes after Ctrl-C.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Mapping
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import IO, TypeVar

import torch

from mjlab.utils.errors import UserError
from mjlab.utils.processes import (
    PARENT_VARIABLE,
    OtherProcessError,
    ProcessRank,
    available_cores,
    process_rank,
)
from mjlab.utils.signals import (
    FORWARDED,
    Interrupted,
    handled_signals,
    interrupting_signal,
    send_signal,
    start_in_background,
)

T = TypeVar("T")

# File through which processes of our launcher meet; torchrun sets MASTER_ADDR and MASTER_PORT instead.
STORE_VARIABLE = "MJLAB_PROCESS_STORE"
# Interfaces on which Gloo and NCCL listen. A user's own choice is kept.
_INTERFACE_VARIABLES = ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")
# Name used by the launcher of mjlab 1.6.
LOG_DIR_VARIABLE = "TORCHRUNX_LOG_DIR"

logger = logging.getLogger(__name__)

# Seconds until a waiting process logs a warning, and until it raises, as torch.
_SECONDS_OF_SILENCE = 5.0
_SECONDS_TO_JOIN = 1800.0
_SECONDS_BETWEEN_LOOKS = 0.05
# Seconds for processes to notice that another one ended, and to report it.
_PATIENCE = 5.0


# Launching.


def launch_workers(
    command: list[str], count: int, environment: Mapping[str, str] | None = None
) -> None:
    """Run `command` in `count` connected processes; return when all have ended.

    Signals are forwarded to every process, once; the launcher waits until they have saved. If one
    process fails, the others are stopped.

    Args:
        command: Program and its arguments.
        count: Number of processes.
        environment: Environment variables to set, besides the ranks of the processes.

    Raises:
        UserError: a process failed; the message has its rank and exit status.
        Interrupted: a signal stopped the processes.
    """
    shared = {**os.environ, **(environment or {})}
    with contextlib.suppress(OSError):
        for _, name in socket.if_nameindex():
            if name in ("lo", "lo0"):
                shared = dict.fromkeys(_INTERFACE_VARIABLES, name) | shared
    shared |= {PARENT_VARIABLE: str(os.getpid())}
    shared |= {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count)}
    # Left by a torchrun, it would lead to a store of that one.
    shared.pop("TORCHELASTIC_USE_AGENT_STORE", None)
    shared.setdefault("OMP_NUM_THREADS", str(max(1, available_cores() // count)))
    # A file that only this user can read: torch's TCPStore listens on all interfaces. The last worker
    # removes it, also when the launcher was killed.
    descriptor, store = tempfile.mkstemp(prefix="mjlab-processes-")
    os.close(descriptor)
    shared[STORE_VARIABLE] = store
    workers: list[subprocess.Popen[bytes]] = []
    received: list[int] = []
    killed: set[subprocess.Popen[bytes]] = set()

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for worker in workers:
            send_signal(worker, FORWARDED[number])

    with handled_signals(forward, FORWARDED):
        try:
            for rank in range(count):
                own = {**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)}
                # A terminal sends Ctrl-C to all of its processes, and a second signal gives up the
                # running iteration.
                workers.append(start_in_background(command, own))
                for number in received:
                    send_signal(workers[-1], FORWARDED[number])
            while None in (codes := [worker.poll() for worker in workers]) and not any(codes):
                time.sleep(_SECONDS_BETWEEN_LOOKS)
        finally:
            end = time.monotonic() + _PATIENCE
            while None in [w.poll() for w in workers] and time.monotonic() < end:
                time.sleep(_SECONDS_BETWEEN_LOOKS)
            killed |= {worker for worker in workers if worker.poll() is None}
            for worker in killed:
                worker.kill()
            for worker in workers:
                worker.wait()
            Path(store).unlink(missing_ok=True)
    failed = [rank for rank, code in enumerate(codes) if code]
    if not failed:
        return
    # The process that failed first, not one that failed because of it or was killed here.
    later = [rank for rank in range(count) if workers[rank] not in killed]
    others = (0, OtherProcessError.exit_status)
    ended = [rank for rank in (*failed, *later) if workers[rank].returncode not in others]
    stopped = {rank: interrupting_signal(workers[rank].returncode) for rank in ended}
    rank = next((rank for rank in ended if stopped[rank] is None), next(iter(ended), failed[0]))
    if received and (stopped.get(rank) is not None or workers[rank] in killed):
        raise Interrupted(received[0])
    code = workers[rank].returncode
    if code > 0 and (number := stopped.get(rank)) is not None:
        raise Interrupted(number)
    how = f"failed with status {code}; see its output above"
    if code < 0:
        how = f"was ended by {signal.Signals(-code).name}"
    if code == -getattr(signal, "SIGKILL", 9):
        how += ", probably because memory ran out"
    raise UserError(f"Process {rank} of {count} {how}. The run has ended in all processes.")


# Process group and collective errors.


def join_processes(device: str) -> bool:
    """Join the process group of the run and wait for all processes; return True if this call joined.

    Returns False in a single process, or if the group was joined before. Tensors on a GPU are
    averaged by NCCL; tensors on the CPU, and objects, by Gloo.

    Raises:
        ValueError: the environment variables of the launcher are contradictory.
        OSError: their address cannot be listened on.
        TimeoutError: not all processes joined within half an hour.
    """
    rank = process_rank()
    if rank.is_alone or torch.distributed.is_initialized():
        return False
    backend = "gloo"
    if torch.device(device).type == "cuda":
        backend = "cpu:gloo,cuda:nccl"
        torch.cuda.set_device(torch.device(device))
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        # torchrun starts all processes, and ends them if one is missing.
        torch.distributed.init_process_group(backend)
        return True
    torch.distributed.init_process_group(
        backend, store=_store_with_all(rank), rank=rank.rank, world_size=rank.world_size
    )
    return True


@contextlib.contextmanager
def joined_processes(device: str) -> Generator[ProcessRank]:
    """Join the process group of the run for the block.

    Raises:
        OtherProcessError: another process of the run ended within the block.
    """
    joined = join_processes(device)
    try:
        yield process_rank()
    except RuntimeError as error:
        # Gloo raises RuntimeError; its name is part of the source path in the message.
        is_lost = isinstance(error, torch.distributed.DistError) or "gloo" in str(error).lower()
        if torch.distributed.is_initialized() and is_lost:
            raise OtherProcessError("Another process of this run ended; see its output.") from error
        raise
    if joined:
        # Not after an error: the call would wait for processes that may have ended.
        torch.distributed.destroy_process_group()


def broadcast_from_first(make: Callable[[], T]) -> T:
    """Call `make` in the first process; return its result in every process.

    Raises:
        Exception: in the first process, the error of `make`.
        OtherProcessError: in the others, if `make` raised.
    """
    if not torch.distributed.is_initialized():
        return make()
    box: list[T | None] = [None]
    with fail_together():
        if process_rank().is_first:
            box[0] = make()
    torch.distributed.broadcast_object_list(box, src=0)
    return box[0]  # ty: ignore[invalid-explicit-return]


@contextlib.contextmanager
def fail_together() -> Generator[None]:
    """Wait for all processes at the end of the block; an error in one raises in all.

    Raises:
        Exception: in the first process that failed, its error.
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


# Output.


@contextlib.contextmanager
def output_of(rank: ProcessRank) -> Generator[ProcessOutput | None]:
    """Capture the output of a process other than the first within the block; None for the first.

    An error that ends the block is not captured: callers print it to the terminal.
    """
    if rank.is_first:
        yield None
        return
    output = ProcessOutput()
    terminal = sys.stderr
    streams = [h for h in logging.getLogger().handlers if isinstance(h, logging.StreamHandler)]
    handlers = [handler for handler in streams if handler.stream is terminal]
    for handler in handlers:
        handler.setStream(output)
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            yield output
    finally:
        for handler in handlers:
            handler.setStream(terminal)
        output.release()


def log_file(rank: ProcessRank, log_dir: str | None, run_dir: Path) -> Path | None:
    """Return the log file of a process, in TORCHRUNX_LOG_DIR, else `log_dir`, else
    `<run>/torchrunx`. None if that is empty: the output is dropped."""
    folder = os.environ.get(LOG_DIR_VARIABLE, log_dir)
    if folder is None:
        folder = str(run_dir / "torchrunx")
    return Path(folder) / f"rank_{rank.rank}.log" if folder else None


class ProcessOutput(io.TextIOBase):
    """Buffer of a process's output, written to a file once `keep_in` sets its path."""

    def __init__(self) -> None:
        self._target: IO[str] | None = io.StringIO()

    def writable(self) -> bool:
        """Return True."""
        return True

    def write(self, text: str) -> int:
        """Write `text`; return its length."""
        if self._target is not None:
            self._target.write(text)
            self._target.flush()
        return len(text)

    def keep_in(self, path: Path | None) -> None:
        """Write earlier and further output to `path`. None: drop all of it."""
        before = self._target.getvalue() if isinstance(self._target, io.StringIO) else ""
        self._target = None
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._target = path.open("w", encoding="utf-8")
            self.write(before)

    def release(self) -> None:
        """Close the file."""
        if self._target is not None:
            self._target.close()
            self._target = None


# Rendezvous.


def _store_with_all(rank: ProcessRank) -> torch.distributed.Store:
    """Return the store of the process group once all processes have joined."""
    begin = time.monotonic()
    names = f"Process {rank.rank} of {rank.world_size}"
    hint = "WORLD_SIZE sets the number of processes; unset it to train in one process."
    where = os.environ.get(STORE_VARIABLE)
    if where is None:
        store, where = _store_at_address(rank, names, hint)
    elif os.path.isfile(where):
        store = torch.distributed.FileStore(where, rank.world_size)
    else:
        raise ValueError(
            f"{STORE_VARIABLE}: expected the file of a running launcher, got {where!r}; unset it and "
            "WORLD_SIZE."
        )
    joined, warned = store.add("mjlab/joined", 1), False
    while joined < rank.world_size:
        waited = time.monotonic() - begin
        progress = f"at {where}: {joined} of {rank.world_size} have joined"
        if waited > _SECONDS_TO_JOIN:
            raise TimeoutError(f"{names} waited {waited:.0f} s for the others {progress}. {hint}")
        if waited > _SECONDS_OF_SILENCE and not warned:
            logger.warning("%s waits for the others %s. %s", names, progress, hint)
            warned = True
        time.sleep(_SECONDS_BETWEEN_LOOKS)
        joined = store.add("mjlab/joined", 0)
    if joined > rank.world_size:
        raise ValueError(f"{names}: expected no more processes at {where}, got {joined}. {hint}")
    return store


def _store_at_address(
    rank: ProcessRank, names: str, hint: str
) -> tuple[torch.distributed.Store, str]:
    """Return the store at MASTER_ADDR and MASTER_PORT, and its address; process 0 owns it.

    It listens on all interfaces, as torch does. On POSIX, it listens on MASTER_ADDR alone if that is `localhost`,
    `127.*` or `::1`.
    """
    host, port = os.environ.get("MASTER_ADDR"), os.environ.get("MASTER_PORT")
    if not host or port is None or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(
            f"WORLD_SIZE={rank.world_size}: expected MASTER_ADDR and MASTER_PORT (1 to 65535) of process "
            f"0, got {host!r} and {port!r}; use torchrun, or unset WORLD_SIZE."
        )
    where = f"{host}:{port}"
    # The constructor does not return while the store is missing.
    timer = threading.Timer(
        _SECONDS_OF_SILENCE,
        lambda: logger.warning("%s waits for process 0 at %s. %s", names, where, hint),
    )
    timer.daemon = True
    timer.start()
    listening = None
    try:
        is_local = re.fullmatch(r"localhost|127(\.\d+){1,3}|::1", host) is not None
        if rank.is_first and os.name == "posix" and is_local:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listening = socket.create_server((host, int(port)), family=family).detach()
        store = torch.distributed.TCPStore(
            host,
            int(port),
            rank.world_size,
            is_master=rank.is_first,
            timeout=timedelta(seconds=_SECONDS_TO_JOIN),
            wait_for_workers=False,
            master_listen_fd=listening,
        )
    except (torch.distributed.DistError, OSError) as error:
        if rank.is_first:
            raise OSError(
                f"MASTER_ADDR, MASTER_PORT: expected an address that {names} can listen on, got "
                f"{where}; use another port."
            ) from error
        raise TimeoutError(f"{names} found no process 0 at {where}. {hint}") from error
    finally:
        timer.cancel()
    return store, where
