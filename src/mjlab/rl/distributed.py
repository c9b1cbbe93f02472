"""Several processes that train one policy: starting them, joining them, keeping them together.

Every process has environments and random numbers of its own. rsl_rl averages gradients, the
statistics of observation normalizers, and the policy change that the learning rate follows, so that
all processes hold the same networks after every update. The first process alone writes files.

`launch_workers` is not torch's launcher, which sends SIGTERM to all processes as soon as it sees one
end with an error: one that only lost its connection is then named, and the one that failed is ended
before it can say why. Nor does that one report the exit status of processes after Ctrl-C.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import subprocess
import sys
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
    cores_per_process,
    process_rank,
)
from mjlab.utils.signals import FORWARDED, handled_signals

T = TypeVar("T")

# Set by our launcher, as host:port; torchrun announces its store by MASTER_ADDR and MASTER_PORT.
STORE_VARIABLE = "MJLAB_PROCESS_STORE"
# Under this name the reference's launcher has it.
LOG_DIR_VARIABLE = "TORCHRUNX_LOG_DIR"

logger = logging.getLogger(__name__)

# Seconds after which a process says for whom it waits, and after which it gives up, as torch does.
_SECONDS_OF_SILENCE = 5.0
_SECONDS_TO_JOIN = 1800.0
_SECONDS_BETWEEN_LOOKS = 0.05
# Seconds that processes may take to notice that one of them is gone, and to say so.
_PATIENCE = 5.0


# Launching.


def launch_workers(
    command: list[str], count: int, environment: Mapping[str, str] | None = None
) -> None:
    """Run `command` in `count` processes that find each other; return when all have ended.

    A signal goes on to every process, once, and what they then do, such as saving, is waited for. A
    process that fails takes the others with it.

    Args:
        command: The program and its arguments.
        count: Number of processes.
        environment: Environment variables to set, besides those that number the processes.

    Raises:
        UserError: a process failed; the message says which, and how it ended.
        KeyboardInterrupt: the processes were told to stop before they could.
    """
    # The store, in which processes find each other, is this process's own, so that its port cannot
    # be taken by others in between.
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = {**os.environ, **(environment or {}), STORE_VARIABLE: f"127.0.0.1:{store.port}"}
    shared |= {PARENT_VARIABLE: str(os.getpid())}
    shared |= {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count)}
    shared.setdefault("OMP_NUM_THREADS", str(max(1, cores_per_process() // count)))
    workers: list[subprocess.Popen[bytes]] = []
    received: list[signal.Signals] = []
    killed = set()

    def forward(number: int, frame: FrameType | None) -> None:
        received.append(FORWARDED[number])
        for worker in workers:
            worker.send_signal(FORWARDED[number])

    with handled_signals(forward, FORWARDED):
        for rank in range(count):
            own = {**shared, "RANK": str(rank), "LOCAL_RANK": str(rank)}
            # A session of its own: a terminal sends Ctrl-C to all processes of its session, and a
            # second signal tells training to stop at once.
            workers.append(subprocess.Popen(command, env=own, start_new_session=True))
            for number in received:
                workers[-1].send_signal(number)
        try:
            while not (ended := _failed(workers)) and _running(workers):
                time.sleep(_SECONDS_BETWEEN_LOOKS)
        finally:
            end = time.monotonic() + _PATIENCE
            while _running(workers) and time.monotonic() < end:
                time.sleep(_SECONDS_BETWEEN_LOOKS)
            for rank in _running(workers):
                workers[rank].kill()
                killed.add(rank)
            for worker in workers:
                worker.wait()
    if not ended:
        return
    # The one that failed, and not one that gave up because of it, or that had to be killed.
    candidates = [rank for rank in (*ended, *_failed(workers)) if rank not in killed]
    rank = next(
        (rank for rank in candidates if workers[rank].returncode != OtherProcessError.exit_status),
        ended[0],
    )
    code = workers[rank].returncode
    if received and code in (130, -signal.SIGINT):
        raise KeyboardInterrupt
    how = f"failed with status {code}; what it printed above says why"
    if code < 0:
        how = f"was ended by {signal.Signals(-code).name}"
    if code == -signal.SIGKILL:
        how += ", which is what happens where memory runs out"
    raise UserError(f"Process {rank} of {count} {how}. The run has ended in all processes.")


# Joining, and failing together.


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
        # Gloo raises plain errors, in which its name is part of the place in its source.
        is_lost = isinstance(error, torch.distributed.DistError) or "gloo" in str(error).lower()
        if torch.distributed.is_initialized() and is_lost:
            raise OtherProcessError(
                "Another process of this run ended; what it printed says why."
            ) from error
        raise
    if joined:
        # Not after an error: the others may be gone, and this would wait for them.
        torch.distributed.destroy_process_group()


def broadcast_from_first(make: Callable[[], T]) -> T:
    """Return, in every process, what `make` returns in the first, which alone calls it.

    Raises:
        Exception: in the first process, what `make` raises.
        OtherProcessError: in the others, if it raised.
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


# Output.


@contextlib.contextmanager
def output_of(rank: ProcessRank) -> Generator[ProcessOutput | None]:
    """Take, within the block, what a process other than the first prints; None for the first.

    An error that ends the block is not among it: whoever prints it prints it to the terminal.
    """
    if rank.is_first:
        yield None
        return
    output = ProcessOutput()
    handlers = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stderr
    ]
    terminal = sys.stderr
    for handler in handlers:
        handler.setStream(output)
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            yield output
    finally:
        for handler in handlers:
            handler.setStream(terminal)
        output.release()


def log_file(rank: ProcessRank, asked: str | None, run_dir: Path) -> Path | None:
    """Return the file for what a process prints: below TORCHRUNX_LOG_DIR, else `asked`, else
    `<run>/torchrunx`. None where that is empty: it is dropped then."""
    folder = os.environ.get(LOG_DIR_VARIABLE, asked)
    if folder is None:
        folder = str(run_dir / "torchrunx")
    return Path(folder) / f"rank_{rank.rank}.log" if folder else None


class ProcessOutput(io.TextIOBase):
    """Takes what a process prints, and writes it to a file once it is told which."""

    def __init__(self) -> None:
        self._target: IO[str] | None = io.StringIO()

    def writable(self) -> bool:
        """Whether this can be written to."""
        return True

    def write(self, text: str) -> int:
        """Take `text`; return its length."""
        if self._target is not None:
            self._target.write(text)
            self._target.flush()
        return len(text)

    def keep_in(self, path: Path | None) -> None:
        """Write to `path` from now on, and what was printed before, too; None: drop it all."""
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


# Helpers of launching and joining.


def _running(workers: list[subprocess.Popen[bytes]]) -> list[int]:
    return [rank for rank, worker in enumerate(workers) if worker.poll() is None]


def _failed(workers: list[subprocess.Popen[bytes]]) -> list[int]:
    return [rank for rank, worker in enumerate(workers) if worker.poll() not in (None, 0)]


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
