"""Process ranks of a training run, and CPU cores per process.

torchrun and mjlab's launcher set the environment variables RANK, LOCAL_RANK, WORLD_SIZE and
LOCAL_WORLD_SIZE. Without these variables, the run has one process.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import platform
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mjlab.utils.errors import MjlabError

# Process id of the launcher, set for children that must end with their launcher.
PARENT_VARIABLE = "MJLAB_PARENT_PID"
CORES_VARIABLE = "MJLAB_CORES"
"""Environment variable: upper bound on the CPU cores that this process and its children use."""

_SECONDS_BETWEEN_LOOKS = 0.5
_OWN_CGROUPS = Path("/proc/self/cgroup")
_CGROUP_ROOT = Path("/sys/fs/cgroup")
# Files with quota and period in microseconds, by version of control groups. Without a limit, the
# quota is "max" or -1.
_QUOTA_FILES = {1: ("cpu.cfs_quota_us", "cpu.cfs_period_us"), 2: ("cpu.max",)}


@dataclass(frozen=True)
class ProcessRank:
    """Rank of this process in a run."""

    rank: int = 0
    """Index of this process among all processes, from 0."""
    world_size: int = 1
    """Number of processes on all machines."""
    local_rank: int = 0
    """Index of this process among the processes on this machine, from 0."""
    local_world_size: int = 1
    """Number of processes on this machine."""

    @property
    def is_first(self) -> bool:
        """True for the main process (rank 0), which writes files and prints output."""
        return self.rank == 0

    @property
    def is_alone(self) -> bool:
        """True if the run has only one process."""
        return self.world_size == 1

    def __str__(self) -> str:
        return f"process {self.rank} of {self.world_size}"


def process_rank() -> ProcessRank:
    """Return the rank of this process in its run.

    Raises:
        ValueError: the environment variables are inconsistent or not integers.
    """
    world_size = environment_integer("WORLD_SIZE", 1)
    rank = environment_integer("RANK", 0, minimum=0)
    local_rank = environment_integer("LOCAL_RANK", rank, minimum=0)
    local_world_size = environment_integer("LOCAL_WORLD_SIZE", world_size)
    if not (rank < world_size and local_rank < local_world_size <= world_size):
        raise ValueError(
            "Expected RANK < WORLD_SIZE and LOCAL_RANK < LOCAL_WORLD_SIZE <= WORLD_SIZE, got "
            f"RANK={rank}, WORLD_SIZE={world_size}, LOCAL_RANK={local_rank} and "
            f"LOCAL_WORLD_SIZE={local_world_size}. torchrun sets these variables; unset them to "
            "train in one process."
        )
    return ProcessRank(rank, world_size, local_rank, local_world_size)


def environment_integer(variable: str, default: int, minimum: int = 1) -> int:
    """Return an integer from an environment variable; `default` if unset or empty.

    Raises:
        ValueError: the value is not an integer >= `minimum`.
    """
    text = os.environ.get(variable) or str(default)
    if not text.isdigit() or int(text) < minimum:
        raise ValueError(
            f"Environment variable {variable}: expected an integer >= {minimum}, got {text!r}; unset "
            "it for the default (torchrun sets RANK and WORLD_SIZE)."
        )
    return int(text)


class OtherProcessError(MjlabError, RuntimeError):
    """Failure of another process of the run, which reports the cause itself."""

    exit_status = 3


@functools.cache
def end_with_launcher() -> None:
    """Send SIGTERM to this process when its launcher ends, even by SIGKILL, so that training saves.

    No effect unless mjlab's commands or torchrun started this process, because a shell may end before
    its children.
    """
    # Popped, because child processes must not inherit the variable.
    launcher_id = os.environ.pop(PARENT_VARIABLE, None)
    # Only POSIX changes the parent id when the parent ends.
    if os.name != "posix" or (launcher_id is None and "TORCHELASTIC_RUN_ID" not in os.environ):
        return
    parent = os.getppid()
    # The launcher may differ from the parent: a wrapper may be in between.
    launcher = parent if launcher_id is None else int(launcher_id)

    def watch() -> None:
        with contextlib.suppress(ProcessLookupError):
            while os.getppid() == parent:
                # A launcher of another user is running, too.
                with contextlib.suppress(PermissionError):
                    os.kill(launcher, 0)
                time.sleep(_SECONDS_BETWEEN_LOOKS)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="end-with-launcher", daemon=True).start()


def cores_per_process() -> int:
    """Return the number of CPU cores per process of the run on this machine, at least 1."""
    return max(1, available_cores() // process_rank().local_world_size)


def machine(device: str) -> str:
    """Return a description of this machine: cores, processor and, for a CUDA device, GPU."""
    found = f"{available_cores()} cores ({processor()})"
    if device.startswith("cuda"):
        import torch

        found += f", {torch.cuda.get_device_name(device)}"
    return found


def processor() -> str:
    """Return the name of the processor."""
    file = Path("/proc/cpuinfo")
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def available_cores() -> int:
    """Return the number of CPU cores for this process: affinity mask or cgroup quota, rounded up.

    `MJLAB_CORES` limits the number, for several runs side by side.

    A container limited to two cores still sees all cores of its host; the scheduler throttles
    threads beyond the quota in the middle of a step.
    """
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    quotas = [
        quota
        for group, version in control_groups("cpu")
        if (quota := _quota(group, _QUOTA_FILES[version])) is not None
    ]
    limit = environment_integer(CORES_VARIABLE, cores)
    return max(1, min(cores, limit, math.ceil(min(quotas, default=cores))))


def control_groups(controller: str) -> Iterator[tuple[Path, int]]:
    """Yield folder and version (1 or 2) of each control group that may limit this process.

    Limits of a group's ancestors apply too. Lines of `/proc/self/cgroup` are
    `<number>:<controllers>:<path>`; version 2 has no controllers.
    """
    try:
        lines = _OWN_CGROUPS.read_text(encoding="utf-8").splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        for mount in {controllers, controller} if controllers else ("", "unified"):
            folder = _CGROUP_ROOT / mount / path.lstrip("/")
            for group in (folder, *folder.parents):
                if group.is_relative_to(_CGROUP_ROOT):
                    yield group, 2 - bool(controllers)


def _quota(group: Path, files: tuple[str, ...]) -> float | None:
    """Return the quota of a control group in cores. None: no limit."""
    try:
        words = " ".join((group / file).read_text(encoding="utf-8") for file in files).split()
    except OSError:
        return None
    if len(words) != 2 or not all(word.isdigit() and int(word) > 0 for word in words):
        return None
    return int(words[0]) / int(words[1])
