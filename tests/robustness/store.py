"""Launches of two processes: addresses, strangers, stale variables, killed launchers."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import socket
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from .commands import Command, last_line
from .trials import Broken, Trial, descendants

WHAT = "strangers at the ports of a launch, stale variables, two launches at once, killed launchers"
TRIALS = 40
LIMIT = 120.0

_LOOPBACK = ("0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000")
# Adds up the ranks for some time.
_WORKER = """
import os, pathlib, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_DFL)
import torch
from mjlab.rl.distributed import joined_processes
from mjlab.utils.processes import end_with_launcher
end_with_launcher()
with joined_processes('cpu') as rank:
    pathlib.Path(sys.argv[1], f'joined_{rank.rank}').touch()
    end = torch.zeros(1)
    begin = time.monotonic()
    while not end.item():
        total = torch.tensor([rank.rank + 1.0])
        torch.distributed.all_reduce(total)
        assert total.item() == 3.0, total
        end.fill_(float(time.monotonic() - begin > float(sys.argv[2])))
        torch.distributed.all_reduce(end)
"""
_STALE = (
    {"MASTER_ADDR": "192.0.2.1", "MASTER_PORT": "1"}, {"MASTER_ADDR": "", "MASTER_PORT": "many"},
    {"MJLAB_PROCESS_STORE": "/nonexistent/store"}, {"MJLAB_PROCESS_STORE": "127.0.0.1:1"},
    {"RANK": "5", "WORLD_SIZE": "7", "LOCAL_RANK": "5"}, {"LOCAL_WORLD_SIZE": "9"},
    {"TORCHELASTIC_USE_AGENT_STORE": "True", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "9"},
    {"TORCHELASTIC_RUN_ID": "old"}, {"MJLAB_PARENT_PID": "1"}, {"MJLAB_PARENT_PID": "999999"},
    {"GLOO_SOCKET_IFNAME": "lo"},
)  # fmt: skip


def prepare(folder: Path) -> None:
    """Return nothing: trials share no data."""


def run(trial: Trial, prepared: Any) -> None:
    """Launch two processes, disturb them, and check how they end."""
    kind = ("strangers", "stale", "two", "killed")[trial.number % 4]
    rng = trial.rng
    stale = rng.choice(_STALE) if kind == "stale" else {}
    number = rng.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP))
    delay = rng.uniform(0.0, 4.0)
    details = {"stale": f"{stale}", "killed": f"by {number.name} at {delay:.1f}"}
    trial.trying(f"{kind} {details.get(kind, '')}".strip())
    names = ("one", "other") if kind == "two" else ("one",)
    launches = [_launch(name, 1.0 if kind == "strangers" else 0.3, stale) for name in names]
    if kind == "killed":
        launches[0].watch(delay)
        with contextlib.suppress(ProcessLookupError):
            os.kill(launches[0].pid, number)
    for name, launch in zip(names, launches, strict=True):
        joined = [Path(name, f"joined_{rank}") for rank in range(2)]
        launch.watch(60.0, lambda joined=joined: all(path.exists() for path in joined))
        for address, port in _listening(launch.pid):
            if address not in _LOOPBACK:
                raise Broken(f"listens on {address} (hexadecimal), port {port}")
            if kind == "strangers":
                _disturb(trial, port)
        ended = launch.end(60.0)
        statuses = (0,) if kind != "killed" else (0, 128 + number, -number)
        if ended.stuck or ended.status not in statuses or "Traceback" in ended.said:
            raise Broken(ended.stuck or f"exit status {ended.status}: {last_line(ended.said)}")
        if list(Path(name).glob("mjlab-processes-*")) and number is not signal.SIGKILL:
            raise Broken("a store is left")
    # Workers notice that their launcher ended once they have loaded their modules.
    end = time.monotonic() + 30.0
    while descendants(os.getpid()) and time.monotonic() < end:
        time.sleep(0.05)


def _launch(name: str, seconds: float, variables: dict[str, str]) -> Command:
    Path(name).mkdir()
    worker = [sys.executable, "-c", _WORKER, name, str(seconds)]
    return Command(
        "train",
        ["Mjlab-Cartpole-Swingup"],
        before=functools.partial(_become, worker, name, variables),
    )


def _become(worker: list[str], folder: str, variables: dict[str, str]) -> None:
    """Let `train` launch two processes of `worker`, as it does on a machine with two GPUs."""
    from mjlab.rl.distributed import launch_workers
    from mjlab.scripts import train

    os.environ.update(variables)
    tempfile.tempdir = folder
    train.command = lambda argv, prog: launch_workers(worker, 2)


def _disturb(trial: Trial, port: int) -> None:
    for _ in range(trial.rng.randint(1, 5)):
        data = trial.rng.choice(
            (b"", trial.rng.randbytes(8), trial.rng.randbytes(5000), b"GET / HTTP/1.1\r\n\r\n")
        )
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", port), 2.0) as client,
        ):
            client.sendall(data)


def _listening(pid: int) -> list[tuple[str, int]]:
    """Return the addresses (hexadecimal) and ports on which `pid` and its descendants listen."""
    inodes = set()
    for one in (pid, *descendants(pid)):
        with contextlib.suppress(OSError):
            for entry in os.scandir(f"/proc/{one}/fd"):
                with contextlib.suppress(OSError):
                    inodes.add(os.readlink(entry.path))
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    own = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]
    return [(address, int(port, 16)) for address, port in (text.split(":") for text in own)]
