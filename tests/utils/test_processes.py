"""Process ranks from environment variables, and CPU cores per process."""

from __future__ import annotations

import os

import pytest

from mjlab.utils import processes
from mjlab.utils.processes import ProcessRank, available_cores, cores_per_process, process_rank

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
        (("one", 2, 0, 2), "RANK: .*'one'"),
        ((0, 0, 0, 1), "WORLD_SIZE: .*'0'"),
        ((0, -2, 0, 1), "WORLD_SIZE: .*'-2'"),
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


@pytest.fixture
def cgroups(tmp_path, monkeypatch):
    """Return a function that puts this process, with 16 cores, into control groups."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(16)), raising=False)
    monkeypatch.setattr(processes, "_OWN_CGROUPS", tmp_path / "own")
    monkeypatch.setattr(processes, "_CGROUP_ROOT", tmp_path / "fs")

    def join(groups, files):
        (tmp_path / "own").write_text(groups)
        for name, text in files.items():
            file = tmp_path / "fs" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    return join


CPU, UNLIMITED = {"cpu/cpu.cfs_period_us": "100000\n"}, {"cpu/cpu.cfs_quota_us": "-1\n"}


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "250000 100000\n"}, 3),
        ("0::/\n", {"cpu.max": "20000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 16),
        ("0::/\n", {"cpu.max": "6400000 100000\n"}, 16),
        ("0::/\n", {}, 16),
        # The least of a group and of those above it.
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "300000 100000\n"}, 3),
        ("0::/a/b\n", {"a/b/cpu.max": "400000 100000\n", "cpu.max": "900000 100000\n"}, 4),
        # A container sees its own group as the root, and may know itself by the host's path.
        ("0::/docker/1f\n", {"cpu.max": "500000 100000\n"}, 5),
        # Version 1, alone and with version 2 beside it.
        ("1:cpu:/\n", {**CPU, "cpu/cpu.cfs_quota_us": "600000\n"}, 6),
        ("1:cpu:/\n", {**CPU, **UNLIMITED}, 16),
        (
            "4:cpu,cpuacct:/job\n0::/\n",
            {
                "cpu,cpuacct/job/cpu.cfs_quota_us": "700000\n",
                "cpu,cpuacct/job/cpu.cfs_period_us": "100000\n",
            },
            7,
        ),
        ("4:cpuset:/\n", {"cpuset/cpu.max": "100000 100000\n"}, 16),
    ],
)
def test_threads_follow_the_quota_of_the_container(cgroups, groups, files, cores):
    cgroups(groups, files)
    assert available_cores() == cores


def test_the_affinity_mask_and_the_ranks_limit_the_quota_further(cgroups, launched, monkeypatch):
    cgroups("0::/\n", {"cpu.max": "600000 100000\n"})
    launched(0, 3, 0, 3)
    assert cores_per_process() == 2
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(4)), raising=False)
    assert available_cores() == 4


def test_a_system_without_control_groups_is_not_limited(cgroups):
    assert available_cores() == 16


@pytest.mark.parametrize("limit", [1, 10_000])
def test_a_variable_limits_the_cores(monkeypatch, limit):
    monkeypatch.delenv(processes.CORES_VARIABLE, raising=False)
    cores = processes.available_cores()
    monkeypatch.setenv(processes.CORES_VARIABLE, str(limit))
    assert processes.available_cores() == min(cores, limit)
    monkeypatch.setenv(processes.CORES_VARIABLE, "none")
    with pytest.raises(ValueError, match="MJLAB_CORES"):
        processes.available_cores()
