"""Which process of a run this one is, as launchers say by environment variables."""

from __future__ import annotations

import os

import pytest

from mjlab.utils.processes import ProcessRank, cores_per_process, process_rank

VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")


@pytest.fixture
def launched(monkeypatch):
    """Return a function that sets the variables, in the order of VARIABLES; None leaves one out."""

    def launch(*values: str | int | None) -> None:
        for name, value in zip(VARIABLES, values, strict=True):
            monkeypatch.delenv(name, raising=False)
            if value is not None:
                monkeypatch.setenv(name, str(value))

    launch(None, None, None, None)
    return launch


def test_without_a_launcher_there_is_one_process(launched):
    rank = process_rank()
    assert rank == ProcessRank(0, 1, 0, 1)
    assert rank.is_first
    assert rank.is_alone


def test_a_launcher_numbers_processes_over_all_machines_and_on_each(launched):
    launched(5, 8, 1, 4)
    rank = process_rank()
    assert rank == ProcessRank(rank=5, world_size=8, local_rank=1, local_world_size=4)
    assert (rank.is_first, rank.is_alone) == (False, False)
    assert str(rank) == "process 5 of 8"


def test_a_launcher_that_says_no_local_numbers_is_on_one_machine(launched):
    launched(1, 2, None, None)
    assert process_rank() == ProcessRank(1, 2, 1, 2)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ((2, 2, 0, 2), "RANK=2"),
        ((0, 2, 3, 2), "LOCAL_RANK=3"),
        ((0, 2, 0, 4), "LOCAL_WORLD_SIZE=4"),
        (("one", 2, 0, 2), "RANK is 'one'"),
        ((0, 0, 0, 1), "WORLD_SIZE is '0'"),
        ((0, -2, 0, 1), "WORLD_SIZE is '-2'"),
    ],
)
def test_variables_that_make_no_sense_are_named(launched, values, named):
    launched(*values)
    with pytest.raises(ValueError, match=named):
        process_rank()


@pytest.mark.parametrize(("processes", "cores"), [(1, 6), (2, 3), (4, 1), (9, 1)])
def test_processes_share_the_cores_of_their_machine(launched, monkeypatch, processes, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(6)), raising=False)
    launched(0, processes, 0, processes)
    assert cores_per_process() == cores
