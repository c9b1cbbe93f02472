"""The processes that share a training run, as torchrun and our own launcher number them.

Both set the environment variables RANK, LOCAL_RANK, WORLD_SIZE and LOCAL_WORLD_SIZE. Without them
there is one process.
"""

from __future__ import annotations

import functools
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mjlab.utils.errors import MjlabError

# Set for a child that is to end with the process that started it: the number of that process.
PARENT_VARIABLE = "MJLAB_PARENT_PID"

_SECONDS_BETWEEN_LOOKS = 0.5
_OWN_CGROUPS = Path("/proc/self/cgroup")
_CGROUP_ROOT = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class ProcessRank:
    """Which of the processes of a run this one is."""

    rank: int = 0
    """Number of this process among all, from 0."""
    world_size: int = 1
    """Number of processes of the run, over all machines."""
    local_rank: int = 0
    """Number of this process among those of this machine, from 0."""
    local_world_size: int = 1
    """Number of processes of the run on this machine."""

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files and talks to people."""
        return self.rank == 0

    @property
    def is_alone(self) -> bool:
        """Whether the run has no other process."""
        return self.world_size == 1

    def __str__(self) -> str:
        return f"process {self.rank} of {self.world_size}"


def process_rank() -> ProcessRank:
    """Return which of the processes of a run this one is.

    Raises:
        ValueError: the environment variables contradict each other, or are no numbers.
    """
    world_size = _number("WORLD_SIZE", 1)
    rank = _number("RANK", 0)
    local_rank = _number("LOCAL_RANK", rank)
    local_world_size = _number("LOCAL_WORLD_SIZE", world_size)
    if not (rank < world_size and local_rank < local_world_size <= world_size):
        raise ValueError(
            f"RANK={rank} has to be below WORLD_SIZE={world_size}, and LOCAL_RANK={local_rank} "
            f"below LOCAL_WORLD_SIZE={local_world_size}, which is at most WORLD_SIZE. torchrun "
            "sets these variables; unset them to train in one process."
        )
    return ProcessRank(rank, world_size, local_rank, local_world_size)


def _number(variable: str, default: int) -> int:
    text = os.environ.get(variable, "")
    if text == "":
        return default
    least = 1 if variable.endswith("WORLD_SIZE") else 0
    if not text.isdigit() or int(text) < least:
        raise ValueError(
            f"The environment variable {variable} is {text!r}; it has to be a whole number of at "
            f"least {least}. torchrun sets it; unset it to train in one process."
        )
    return int(text)


class OtherProcessError(MjlabError, RuntimeError):
    """Another process of the run failed, and said why; this one cannot go on without it."""

    exit_status = 3


@functools.cache
def end_with_launcher() -> None:
    """Let this process get SIGTERM when its launcher is gone, even by SIGKILL; training then saves.

    Does nothing unless our commands or torchrun started it: a shell may leave before its children.
    """
    # Not for processes that this one starts.
    given = os.environ.pop(PARENT_VARIABLE, None)
    # Elsewhere the number of a parent does not change when it ends.
    if os.name != "posix" or (given is None and "TORCHELASTIC_RUN_ID" not in os.environ):
        return
    parent = os.getppid()
    # A wrapper may stand between.
    launcher = parent if given is None else int(given)

    def watch() -> None:
        while os.getppid() == parent and _is_running(launcher):
            time.sleep(_SECONDS_BETWEEN_LOOKS)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="end-with-launcher", daemon=True).start()


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        # It is another user's.
        pass
    return True


def cores_per_process() -> int:
    """Return the number of CPU cores for each process of the run on this machine, at least 1."""
    return max(1, available_cores() // process_rank().local_world_size)


def available_cores() -> int:
    """Return the number of CPU cores this process may use: its affinity mask or quota, rounded up.

    A container limited to two cores still sees all cores of its host; threads beyond the quota
    are put to sleep in the middle of a step.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    # Quotas of this process's control group and of all groups above it apply together.
    quotas = [
        quota
        for folder, read in _control_groups()
        for group in (folder, *folder.parents)
        if group.is_relative_to(_CGROUP_ROOT) and (quota := read(group)) is not None
    ]
    return max(1, min(cores, math.ceil(min(quotas, default=cores))))


def _control_groups() -> Iterator[tuple[Path, Callable[[Path], float | None]]]:
    """Yield the folder of each control group that may limit this process, and its reader.

    A line of `/proc/self/cgroup` is `<number>:<controllers>:<path>`; version 2 has no controllers.
    """
    try:
        lines = _OWN_CGROUPS.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        group = path.lstrip("/")
        if not controllers:
            yield _CGROUP_ROOT / group, _quota_v2
            yield _CGROUP_ROOT / "unified" / group, _quota_v2
        elif "cpu" in controllers.split(","):
            yield _CGROUP_ROOT / controllers / group, _quota_v1
            yield _CGROUP_ROOT / "cpu" / group, _quota_v1


def _quota_v2(group: Path) -> float | None:
    # "<quota> <period>" in microseconds; the quota is "max" if there is no limit.
    return _ratio(*_words(group / "cpu.max"))


def _quota_v1(group: Path) -> float | None:
    # The quota is -1 if there is no limit.
    names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
    return _ratio(*(word for name in names for word in _words(group / name)))


def _words(file: Path) -> list[str]:
    try:
        return file.read_text().split()
    except OSError:
        return []


def _ratio(*words: str) -> float | None:
    if len(words) != 2 or not all(word.isdigit() and int(word) > 0 for word in words):
        return None
    return int(words[0]) / int(words[1])
