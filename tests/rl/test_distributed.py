"""Processes that wait for others say for whom, and do not wait for ever."""

from __future__ import annotations

import socket

import pytest
import torch

from mjlab.rl import distributed


@pytest.fixture
def one_of_two(monkeypatch):
    """Return a function that makes this process one of two, without the other; returns the address."""

    def launch(rank: int, port: int | None = None) -> str:
        if port is None:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
        variables = {"RANK": rank, "WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        for name, value in variables.items():
            monkeypatch.setenv(name, str(value))
        return f"127.0.0.1:{port}"

    monkeypatch.setattr(distributed, "_SECONDS_OF_SILENCE", 0.1, raising=False)
    monkeypatch.setattr(distributed, "_SECONDS_TO_JOIN", 1.0, raising=False)
    return launch


@pytest.mark.parametrize(("rank", "whom"), [(0, "1 of 2 have joined"), (1, "process 0 at")])
def test_a_process_alone_says_for_whom_it_waits_and_gives_up(one_of_two, caplog, rank, whom):
    address = one_of_two(rank)
    with pytest.raises(TimeoutError, match=f"Process {rank} of 2.*{address}"):
        distributed.join_processes("cpu")
    (record,) = caplog.records
    for part in (f"Process {rank} of 2 waits", address, whom, "WORLD_SIZE"):
        assert part in record.getMessage()


def test_an_address_that_is_taken_is_named(one_of_two):
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        address = one_of_two(0, taken.getsockname()[1])
        with pytest.raises(OSError, match=f"MASTER_PORT.*{address}"):
            distributed.join_processes("cpu")


@pytest.mark.parametrize("port", [None, "many", "0", "99999"])
def test_an_address_that_is_missing_is_named(monkeypatch, port):
    monkeypatch.setenv("WORLD_SIZE", "2")
    if port is not None:
        monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
        monkeypatch.setenv("MASTER_PORT", port)
    with pytest.raises(ValueError, match="expected MASTER_ADDR and MASTER_PORT"):
        distributed.join_processes("cpu")


def test_a_stale_launch_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("MJLAB_PROCESS_STORE", str(tmp_path / "gone"))
    with pytest.raises(ValueError, match="MJLAB_PROCESS_STORE: expected .*gone.*unset"):
        distributed.join_processes("cpu")
    assert not (tmp_path / "gone").exists()


def test_processes_beyond_the_world_are_named(monkeypatch, tmp_path):
    store = tmp_path / "store"
    torch.distributed.FileStore(str(store), 2).add("mjlab/joined", 2)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("MJLAB_PROCESS_STORE", str(store))
    with pytest.raises(ValueError, match="expected no more processes at .*store, got 3"):
        distributed.join_processes("cpu")
