"""The processes that share a training run, as torchrun and our own launcher number them.

Both set the environment variables RANK, LOCAL_RANK, WORLD_SIZE and LOCAL_WORLD_SIZE. Without them
there is one process.
"""

from __future__ import annotations

import os
from dataclasses import dataclass


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


def cores_per_process() -> int:
    """Return how many CPU cores each process of the run may use on this machine, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, cores // process_rank().local_world_size)
