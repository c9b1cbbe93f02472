"""Starting the processes of a training run on one machine, one a GPU, and ending them together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from types import FrameType

from mjlab.scripts.cli import OTHER_PROCESS_STATUS
from mjlab.utils.errors import UserError
from mjlab.utils.processes import PARENT_VARIABLE, cores_per_process

# What ends the launcher, and what the processes get for it: they save at the first two.
_FORWARDED: dict[int, signal.Signals] = {
    signal.SIGINT: signal.SIGINT,
    signal.SIGTERM: signal.SIGTERM,
    signal.SIGHUP: signal.SIGTERM,
}
_SECONDS_BETWEEN_LOOKS = 0.05
# How long processes may take to notice that one of them is gone, and to say so.
_PATIENCE = 5.0


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
    import torch

    from mjlab.rl.distributed import STORE_VARIABLE

    # The store, in which processes find each other, is this process's own, so that its port cannot
    # be taken by others in between.
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = {**os.environ, **(environment or {}), STORE_VARIABLE: f"127.0.0.1:{store.port}"}
    shared[PARENT_VARIABLE] = str(os.getpid())
    shared.setdefault("OMP_NUM_THREADS", str(max(1, cores_per_process() // count)))
    numbers = {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count)}
    workers: list[subprocess.Popen[bytes]] = []
    with _ForwardedSignals(workers) as signals:
        for rank in range(count):
            own = {**shared, **numbers, "RANK": str(rank), "LOCAL_RANK": str(rank)}
            # A session of its own: a terminal sends Ctrl-C to all processes of its session, and a
            # second signal tells training to stop at once.
            workers.append(subprocess.Popen(command, env=own, start_new_session=True))
            signals.catch_up(workers[-1])
        try:
            first = _wait(workers)
        finally:
            killed = _end(workers)
    if first is None:
        return
    failed = _culprit(first, workers, killed)
    if signals.was_told_to_stop and workers[failed].returncode in (130, -signal.SIGINT):
        raise KeyboardInterrupt
    raise UserError(_how_it_ended(failed, workers[failed].returncode, count))


class _ForwardedSignals:
    """A context in which the signals that would end this process go on to `workers`."""

    def __init__(self, workers: list[subprocess.Popen[bytes]]) -> None:
        self._workers = workers
        self._received: list[signal.Signals] = []
        self._previous: dict[int, object] = {}

    @property
    def was_told_to_stop(self) -> bool:
        """Whether a signal has arrived."""
        return bool(self._received)

    def catch_up(self, worker: subprocess.Popen[bytes]) -> None:
        """Send `worker` what arrived before it was there."""
        for number in self._received:
            worker.send_signal(number)

    def __enter__(self) -> _ForwardedSignals:
        for number in _FORWARDED:
            # What is ignored, as SIGHUP under nohup, stays ignored.
            if signal.getsignal(number) != signal.SIG_IGN:
                self._previous[number] = signal.signal(number, self._forward)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, old in self._previous.items():
            # A handler that was not set from Python reads as None and cannot be set again.
            signal.signal(number, old if old is not None else signal.SIG_DFL)  # ty: ignore

    def _forward(self, number: int, frame: FrameType | None) -> None:
        self._received.append(_FORWARDED[number])
        for worker in self._workers:
            worker.send_signal(_FORWARDED[number])


def _wait(workers: list[subprocess.Popen[bytes]]) -> int | None:
    """Wait until all have ended well, or one has not; return its number, or None."""
    while True:
        codes = [worker.poll() for worker in workers]
        for rank, code in enumerate(codes):
            if code not in (None, 0):
                return rank
        if None not in codes:
            return None
        time.sleep(_SECONDS_BETWEEN_LOOKS)


def _end(workers: list[subprocess.Popen[bytes]]) -> set[int]:
    """Let the processes end by themselves for a while, then end them; return the numbers of those
    that had to be."""
    killed = set()
    end = time.monotonic() + _PATIENCE
    while any(worker.poll() is None for worker in workers) and time.monotonic() < end:
        time.sleep(_SECONDS_BETWEEN_LOOKS)
    for rank, worker in enumerate(workers):
        if worker.poll() is None:
            worker.kill()
            killed.add(rank)
        worker.wait()
    return killed


def _culprit(first: int, workers: list[subprocess.Popen[bytes]], killed: set[int]) -> int:
    """Return the process that failed, of which `first` was the first to be seen ended."""
    blameless = (0, OTHER_PROCESS_STATUS)
    for rank in (first, *range(len(workers))):
        if rank not in killed and workers[rank].returncode not in blameless:
            return rank
    return first


def _how_it_ended(rank: int, code: int, count: int) -> str:
    if code < 0:
        how = f"was ended by {signal.Signals(-code).name}"
        if -code == signal.SIGKILL:
            how += ", which is what happens where memory runs out"
    else:
        how = f"failed with status {code}; what it printed above says why"
    return f"Process {rank} of {count} {how}. The run has ended in all processes."


def train_command(task: str, flags: list[str]) -> list[str]:
    """Return the command that trains `task` with `flags` in a process of its own."""
    return [sys.executable, "-m", "mjlab.scripts.train", task, *flags]
