"""Launcher of several processes: ranks, signals, exit status, output."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mjlab.rl import distributed
from mjlab.rl.distributed import launch_workers, log_file, output_of
from mjlab.utils.errors import UserError
from mjlab.utils.processes import ProcessRank

PROGRAM = "import os, pathlib, signal, sys, time\nrank = os.environ['RANK']\n"


def launch(code: str, count: int = 2, **environment: str) -> None:
    launch_workers([sys.executable, "-c", PROGRAM + code], count, environment)


def launcher(child: str, is_ready: Callable[[], bool]) -> subprocess.Popen:
    """Return a process that has launched two of `child`, once these are ready."""
    parent = (
        "import sys\nfrom mjlab.rl.distributed import launch_workers\n"
        f"launch_workers([sys.executable, '-c', {child!r}], 2)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", parent])
    wait_until(is_ready)
    return process


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)


def test_every_process_gets_a_number_and_the_same_store(tmp_path):
    names = ["RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "MJLAB_PROCESS_STORE", "EXTRA"]
    code = f"text = ' '.join(os.environ[name] for name in {names})\n"
    launch(code + f"pathlib.Path({str(tmp_path)!r}, rank).write_text(text)", 3, EXTRA="more")
    words = [(tmp_path / str(rank)).read_text().split() for rank in range(3)]
    assert [[*word[:4], word[5]] for word in words] == [
        [str(rank), str(rank), "3", "3", "more"] for rank in range(3)
    ]
    assert len({word[4] for word in words}) == 1
    assert not Path(words[0][4]).exists()


LISTENING = r"""
import os, re
def listening(pid):
    links = [os.readlink(entry.path) for entry in os.scandir(f'/proc/{pid}/fd')]
    inodes = {link[8:-1] for link in links if link.startswith('socket:[')}
    rows = [line.split() for name in ('tcp', 'tcp6') for line in open(f'/proc/net/{name}')]
    return [row[1].split(':')[0] for row in rows if row[3] == '0A' and row[9] in inodes]
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_only_this_machine_can_connect(tmp_path):
    code = f"""{LISTENING}
import torch
from mjlab.rl.distributed import join_processes
join_processes('cpu')
torch.distributed.all_reduce(torch.ones(1))
found = listening(os.getpid()) + listening(os.getppid())
interfaces = [os.environ['GLOO_SOCKET_IFNAME'], os.environ['NCCL_SOCKET_IFNAME']]
text = ' '.join([oct(os.stat(os.environ['MJLAB_PROCESS_STORE']).st_mode), *interfaces, *found])
torch.distributed.barrier()
pathlib.Path({str(tmp_path)!r}, rank).write_text(text)
"""
    launch(code)
    for rank in "01":
        mode, gloo, nccl, *addresses = (tmp_path / rank).read_text().split()
        assert (mode, gloo, nccl) == ("0o100600", "lo", "lo")
        # 127.0.0.1 in the byte order of x86 and ARM.
        assert set(addresses) == {"0100007F"}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_store_at_loopback_listens_there(tmp_path):
    ports = {}
    # In the byte order of x86 and ARM.
    expected = {"127.0.0.1": "0100007F", "::1": f"{'0' * 24}01000000"}
    for host in [*expected]:
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            with socket.create_server((host, 0), family=family) as free:
                ports[host] = free.getsockname()[1]
        except OSError:
            # No IPv6.
            del expected[host]
    code = f"""{LISTENING}
import torch
from mjlab.rl.distributed import join_processes
del os.environ['MJLAB_PROCESS_STORE']
found = []
for host, port in {ports}.items():
    os.environ.update(MASTER_ADDR=host, MASTER_PORT=str(port))
    join_processes('cpu')
    found += listening(os.getpid())
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
pathlib.Path({str(tmp_path)!r}, rank).write_text(' '.join(found))
"""
    launch(code)
    assert set((tmp_path / "0").read_text().split()) == set(expected.values())


def test_the_list_of_interfaces_may_be_missing(tmp_path, monkeypatch):
    def fail() -> None:
        raise OSError

    monkeypatch.setattr(socket, "if_nameindex", fail)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    launch("pass", 1)
    assert not list(tmp_path.iterdir())


def test_a_killed_launch_leaves_no_store(tmp_path, monkeypatch):
    """The last worker removes it."""
    child = (
        f"{PROGRAM}from mjlab.rl.distributed import joined_processes\n"
        "store = pathlib.Path(os.environ['MJLAB_PROCESS_STORE'])\n"
        "with joined_processes('cpu'):\n"
        f"    pathlib.Path({str(tmp_path)!r}, rank).write_text(str(store))\n"
        "    time.sleep(1)\n"
    )
    process = launcher(child, lambda: (tmp_path / "1").exists())
    process.kill()
    process.wait()
    store = Path((tmp_path / "1").read_text())
    wait_until(lambda: not store.exists())
    assert not store.exists()


def test_processes_that_are_many_get_few_threads_each(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(distributed, "available_cores", lambda: 7)
    # Left by a torchrun.
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "9")
    code = f"pathlib.Path({str(tmp_path)!r}, rank).write_text(os.environ['OMP_NUM_THREADS'])"
    launch(code, 2)
    assert (tmp_path / "1").read_text() == "3"


@pytest.mark.parametrize(
    ("end", "how"),
    [("sys.exit(5)", "failed with status 5"), ("os.kill(os.getpid(), 9)", "was ended by SIGKILL")],
)
def test_a_process_that_fails_ends_the_others_and_is_named(monkeypatch, end, how):
    monkeypatch.setattr(distributed, "_PATIENCE", 0.3)
    begin = time.monotonic()
    with pytest.raises(UserError, match=f"Process 1 of 2 {how}"):
        launch(f"if rank == '1': {end}\ntime.sleep(60)")
    assert time.monotonic() - begin < 30


def test_a_process_that_gave_up_because_of_another_is_not_the_one_named():
    with pytest.raises(UserError, match="Process 1 of 2 failed with status 1"):
        launch("if rank == '1': time.sleep(0.5); sys.exit(1)\nsys.exit(3)")


@pytest.mark.parametrize(
    "name",
    [
        "SIGINT",
        pytest.param("SIGTERM", marks=pytest.mark.slow),
    ],
)
def test_a_signal_goes_to_every_process_once_and_all_are_waited_for(tmp_path, name):
    child = (
        f"{PROGRAM}folder = pathlib.Path({str(tmp_path)!r})\n"
        "def save(*_):\n"
        "    with (folder / f'saved_{rank}').open('a') as file: file.write('x')\n"
        "    time.sleep(0.4)\n    (folder / f'done_{rank}').touch()\n    os._exit(0)\n"
        f"signal.signal(signal.{name}, save)\n"
        "(folder / f'ready_{rank}').touch()\ntime.sleep(30)\n"
    )
    process = launcher(child, lambda: len(list(tmp_path.glob("ready_*"))) == 2)
    process.send_signal(getattr(signal, name))
    assert process.wait(timeout=30) == 0
    assert sorted(path.name for path in tmp_path.glob("done_*")) == ["done_0", "done_1"]
    assert (tmp_path / "saved_0").read_text() == "x"


def test_a_killed_launcher_ends_its_workers(tmp_path):
    child = (
        f"{PROGRAM}from mjlab.utils.processes import end_with_launcher\n"
        f"folder = pathlib.Path({str(tmp_path)!r})\n"
        "def save(*_):\n    (folder / f'saved_{rank}').touch()\n    os._exit(0)\n"
        "signal.signal(signal.SIGTERM, save)\nend_with_launcher()\n"
        "(folder / f'ready_{rank}').touch()\ntime.sleep(30)\n"
    )
    process = launcher(child, lambda: len(list(tmp_path.glob("ready_*"))) == 2)
    process.kill()
    process.wait()
    wait_until(lambda: len(list(tmp_path.glob("saved_*"))) == 2, 20.0)
    assert len(list(tmp_path.glob("saved_*"))) == 2


def test_what_other_processes_print_goes_to_a_file(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TORCHRUNX_LOG_DIR", raising=False)
    rank = ProcessRank(1, 2, 1, 2)
    path = log_file(rank, None, tmp_path)
    assert path == tmp_path / "torchrunx" / "rank_1.log"
    with output_of(rank) as output:
        assert output is not None
        print("before")
        output.keep_in(path)
        print("after", file=sys.stderr)
    print("later")
    assert path.read_text() == "before\nafter\n"
    assert capsys.readouterr() == ("later\n", "")
    with output_of(rank) as output:
        assert output is not None
        output.keep_in(None)
        print("lost")
    with output_of(ProcessRank(0, 2, 0, 2)) as output:
        assert output is None
        print("seen")
    assert capsys.readouterr() == ("seen\n", "")


def test_the_folder_of_that_file_can_be_chosen(tmp_path, monkeypatch):
    rank = ProcessRank(2, 4, 2, 4)
    monkeypatch.delenv("TORCHRUNX_LOG_DIR", raising=False)
    assert log_file(rank, str(tmp_path / "mine"), tmp_path) == tmp_path / "mine" / "rank_2.log"
    assert log_file(rank, "", tmp_path) is None
    monkeypatch.setenv("TORCHRUNX_LOG_DIR", str(tmp_path / "variable"))
    assert log_file(rank, "", tmp_path) == tmp_path / "variable" / "rank_2.log"
