"""Command lines of mjlab, run in forked processes, and the check of their exits."""

from __future__ import annotations

import atexit
import contextlib
import importlib
import logging
import os
import re
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mjlab.cli import main as cli

from .trials import Broken, descendants

TASK = "Mjlab-Cartpole-Swingup"
SMALL = (
    "--num-envs", "16", "--device", "cpu", "--agent.num-steps-per-env", "8", "--agent.seed", "7",
    "--agent.save-interval", "1",
)  # fmt: skip
"""Flags of a run of 0.05 s an iteration."""

MEMORY = 3 << 30
"""Memory limit of a command (bytes), far above the need of any trial."""
PATIENCE = 25.0
"""Seconds until a busy command receives a signal to end."""
_ANSWER = 10.0
_OUTPUT = 100_000
_KEPT = 1 << 20
# Late imports of commands, done before the fork.
_IMPORTS = (
    "mjlab.envs", "mjlab.rl", "mjlab.rl.evaluation", "mjlab.rl.exporter_utils", "mjlab.rl.plot",
    "mjlab.rl.run_logger", "mjlab.rl.sac", "mjlab.scripts.play", "mjlab.cli.display",
    "mjlab.scripts.evaluate", "mjlab.scripts.export_scene", "mjlab.scripts.play",
    "mjlab.scripts.profile_env", "mjlab.cli.resume", "mjlab.scripts.train",
    "mjlab.scripts.verify", "mjlab.scripts.viz_nan", "mjlab.sim.native.engine",
    "mjlab.tasks.cartpole.cartpole_env_cfg", "mjlab.viewer.base", "matplotlib.figure",
    "matplotlib.backends.backend_agg", "onnx", "onnxruntime", "tensorboard.backend.event_processing",
    "tensorboard.backend.event_processing.event_accumulator", "torch.utils.tensorboard", "tyro",
    "yaml",
)  # fmt: skip


def preload() -> None:
    """Import what the commands do. One thread for torch, so that weights can be compared."""
    os.environ["OMP_NUM_THREADS"] = "1"
    # No uploads and no login prompts.
    os.environ.pop("WANDB_API_KEY", None)
    for name in _IMPORTS:
        importlib.import_module(name)


@dataclass(frozen=True)
class Ended:
    """Result of a finished command."""

    status: int
    """Exit status; the negative signal if one ended it."""
    out: str
    err: str
    size: int
    """Bytes of output."""
    stuck: str | None
    """Reason if the trial killed the command."""
    was_asked: bool
    """True if the command exceeded the time limit and received a signal to end."""

    @property
    def said(self) -> str:
        """Both outputs."""
        return f"{self.out}\n{self.err}"


# Exit statuses after a handled SIGHUP, SIGINT and SIGTERM.
_BY_SIGNAL = (129, 130, 143)


class Command:
    """Command in a forked process."""

    def __init__(
        self,
        script: str,
        argv: Sequence[str],
        *,
        before: Callable[[], None] = lambda: None,
        is_fresh: bool = False,
    ) -> None:
        """Start the command in the working folder.

        Args:
            script: Subcommand of mjlab.
            argv: Arguments of the command.
            before: Called in the process before the command.
            is_fresh: Start Python instead of forking, to include imports.
        """
        self._pipes = [os.pipe(), os.pipe()]
        self._text = [bytearray(), bytearray()]
        self._size = 0
        self._asked = False
        self._memory_due = 0.0
        self._stuck: str | None = None
        self.status: int | None = None
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if not self.pid:
            os.setpgid(0, 0)
            for pipe, target in zip(self._pipes, (1, 2), strict=True):
                os.dup2(pipe[1], target)
                os.close(pipe[0])
                os.close(pipe[1])
            _become(script, list(argv), before, is_fresh)
        for read, write in self._pipes:
            os.close(write)
            os.set_blocking(read, False)

    def watch(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Collect output until the command ends or `until` is true; return False after `seconds`."""
        end = time.monotonic() + seconds
        while self.status is None:
            self._collect(0.01)
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.status = os.waitstatus_to_exitcode(status)
                self._collect(0.0)
            elif self._stuck is None and self._takes_too_much():
                self._stuck = f"took more than {MEMORY >> 30} GiB of memory"
                self.signal(signal.SIGKILL)
            elif until():
                return True
            elif time.monotonic() > end:
                return False
        return True

    def signal(self, number: int) -> None:
        """Send a signal to all processes of the command, as a terminal does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def end(self, patience: float = PATIENCE) -> Ended:
        """Wait for the command to end. After `patience` s it is interrupted, then killed."""
        if not self.watch(patience):
            self._asked = True
            self.signal(signal.SIGINT)
            if not self.watch(_ANSWER):
                self._stuck = f"busy for {patience:.0f} s, and deaf to Ctrl-C for {_ANSWER:.0f} s"
                self.signal(signal.SIGKILL)
                self.watch(5.0)
        for read, _ in self._pipes:
            with contextlib.suppress(OSError):
                os.close(read)
        out, err = (bytes(text).decode(errors="replace") for text in self._text)
        status = -signal.SIGKILL if self.status is None else self.status
        # Shown with `--trial`.
        print(f"{out}{err}[exit status {status}]", flush=True)
        return Ended(status, out, err, self._size, self._stuck, self._asked)

    def _collect(self, seconds: float) -> None:
        reads = [read for read, _ in self._pipes]
        ready, _, _ = select.select(reads, [], [], seconds)
        got = False
        for read, text in zip(reads, self._text, strict=True):
            if read in ready:
                with contextlib.suppress(BlockingIOError):
                    while data := os.read(read, 1 << 16):
                        got = True
                        self._size += len(data)
                        text += data[: _KEPT - len(text)]
        if ready and not got:
            # The ending command closed the pipe.
            time.sleep(seconds)

    def _takes_too_much(self) -> bool:
        """Return True if its processes exceed the limit of private memory; checked at intervals."""
        if time.monotonic() < self._memory_due:
            return False
        self._memory_due = time.monotonic() + 0.2
        total = 0
        for pid in (self.pid, *descendants(self.pid)):
            with contextlib.suppress(OSError, IndexError, ValueError):
                pages = Path(f"/proc/{pid}/statm").read_text().split()
                total += (int(pages[1]) - int(pages[2])) * os.sysconf("SC_PAGE_SIZE")
        return total > MEMORY


def command(
    script: str,
    *argv: str,
    before: Callable[[], None] = lambda: None,
    patience: float = PATIENCE,
) -> Ended:
    """Run a command to its end, see `Command`."""
    return Command(script, argv, before=before).end(patience)


def check_end(ended: Ended, *, statuses: Sequence[int] = (0, 1, 2, *_BY_SIGNAL)) -> None:
    """Raise Broken unless a command succeeded or reported an error message."""
    if ended.stuck:
        raise Broken(ended.stuck)
    # Lines of torch's own log begin with a letter and a date: `W1126 03:29:24`.
    said = re.sub(r"^[IWE]\d{4} .*\n?", "", ended.said, flags=re.M)
    if "Traceback (most recent call last)" in said:
        raise Broken(f"raw traceback: {last_error(said)}")
    if ended.status < 0:
        name = signal.Signals(-ended.status).name
        raise Broken(f"died of {name}: {last_line(ended.said)}")
    if ended.status not in statuses:
        raise Broken(f"exit status {ended.status}: {last_line(ended.said)}")
    if ended.status in (1, 2) and not ended.said.strip():
        raise Broken(f"exit status {ended.status} without a word")
    if ended.size > _OUTPUT:
        raise Broken(f"{ended.size:,} bytes of output")


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def last_error(text: str) -> str:
    """Return the line below the last traceback in `text`."""
    found = re.findall(r"^(?:[\w.]+(?:Error|Exception|Interrupt|Warning|Exit)\b.*)$", text, re.M)
    return (found[-1] if found else last_line(text))[:200]


def last_line(text: str) -> str:
    """Return the last nonempty line of `text`."""
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else "nothing was said"


def _become(script: str, argv: list[str], before: Callable[[], None], is_fresh: bool) -> None:
    """Run the command in this process and exit as Python does."""
    status = 1
    try:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.stdin = open(os.devnull)  # noqa: SIM115
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", closefd=False, buffering=1)  # noqa: SIM115
        # Those of pytest would take the messages.
        logging.root.handlers.clear()
        before()
        if is_fresh:
            os.execv(sys.executable, [sys.executable, "-m", "mjlab.cli.main", script, *argv])
        sys.argv = ["mjlab", script, *argv]
        try:
            cli.main()
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        threading._shutdown()  # ty: ignore[missing-attribute]
        atexit._run_exitfuncs()
        try:
            sys.stdout.flush()
        except OSError as error:
            print(f"Exception ignored in: {sys.stdout!r}\n{error!r}", file=sys.stderr)
            status = 120
    except KeyboardInterrupt:
        status = 130
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(status)
