"""Scoped signal handlers: stop requests, the first Ctrl+C, signals for child processes.

SIGHUP (closed terminal) does not exist on Windows. There, Ctrl-Break (SIGBREAK) takes the place of SIGINT
for processes of another group, which Ctrl-C does not reach.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from types import FrameType
from typing import IO, Any

_HANGUP = getattr(signal, "SIGHUP", None)
_BREAK = getattr(signal, "SIGBREAK", None)

FORWARDED: dict[int, signal.Signals] = {
    signal.SIGINT: signal.SIGINT,
    signal.SIGTERM: signal.SIGTERM,
    **({} if _HANGUP is None else {_HANGUP: signal.SIGTERM}),
    **({} if _BREAK is None else {_BREAK: signal.SIGINT}),
}
"""Signals that end a launcher, and the signal forwarded to its training process. Training saves on
SIGINT and SIGTERM."""


NEW_GROUP: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
"""`creationflags` of a process that Ctrl-C in the terminal does not reach, on Windows; elsewhere
`start_new_session=True` does that."""


def start_in_background(
    command: list[str], environment: dict[str, str], output: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Start `command` so that Ctrl-C in the terminal does not reach it; `send_signal` does.

    `output` receives stdout and stderr. None: those of this process.
    """
    return subprocess.Popen(
        command,
        env=environment,
        stdin=None if output is None else subprocess.DEVNULL,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        creationflags=NEW_GROUP,
        start_new_session=True,
    )


def send_signal(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send SIGINT or SIGTERM to a process of `start_in_background`; on Windows, Ctrl-Break for both."""
    if sys.platform == "win32":
        number = signal.CTRL_BREAK_EVENT
    process.send_signal(number)


def replace_handlers(
    handler: Callable[[int, FrameType | None], None], numbers: Iterable[int]
) -> dict[int, Any]:
    """Install `handler` for the signals `numbers`; return the previous handlers.

    No effect outside the main thread, because only the main thread can handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.signal(number, handler) for number in numbers}


def restore_handlers(previous: dict[int, Any]) -> None:
    """Restore the handlers in `previous` and clear it."""
    while previous:
        number, handler = previous.popitem()
        # Handlers not set from Python read as None and cannot be restored.
        signal.signal(number, handler if handler is not None else signal.SIG_DFL)


def not_ignored(numbers: Iterable[int]) -> list[int]:
    """Return the signals in `numbers` that are not ignored (`nohup` ignores SIGHUP)."""
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


class StopRequest:
    """Context manager: SIGINT, SIGTERM and SIGHUP set `signal_name` instead of ending the process.

    The first signal and the end of the context restore the previous handlers, so a second signal has
    its usual effect. A second SIGHUP is ignored until the end of the context, because a terminal and
    its shell both send SIGHUP. A process that ignores SIGHUP, such as under `nohup`, keeps ignoring
    it. No effect outside the main thread, because only the main thread can handle signals.
    """

    def __init__(self, on_request: Callable[[str], None] | None = None) -> None:
        """Store `on_request`, a callback that receives the signal name."""
        self.signal_name: str | None = None
        self._on_request = on_request
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """True if a signal has arrived."""
        return self.signal_name is not None

    def __enter__(self) -> StopRequest:
        hangup = [] if _HANGUP is None else not_ignored([_HANGUP])
        others = hangup if _BREAK is None else [*hangup, _BREAK]
        self._previous = replace_handlers(self._handle, [signal.SIGINT, signal.SIGTERM, *others])
        return self

    def __exit__(self, *exception: object) -> None:
        restore_handlers(self._previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.signal_name = signal.Signals(number).name
        until_exit = {}
        if _HANGUP in self._previous:
            until_exit[_HANGUP] = self._previous.pop(_HANGUP)
            signal.signal(_HANGUP, signal.SIG_IGN)
        restore_handlers(self._previous)
        self._previous = until_exit
        if self._on_request is not None:
            self._on_request(self.signal_name)


@contextlib.contextmanager
def handled_signals(
    handle: Callable[[int, FrameType | None], None], numbers: Iterable[int]
) -> Generator[None]:
    """Call `handle` for the signals `numbers` within the block, then restore the handlers.

    Ignored signals, such as SIGHUP under `nohup`, stay ignored.
    """
    previous = replace_handlers(handle, not_ignored(numbers))
    try:
        yield
    finally:
        restore_handlers(previous)


@contextlib.contextmanager
def first_interrupt_calls(callback: Callable[[], None], enabled: bool) -> Generator[None]:
    """Call `callback` on the first Ctrl+C; a second Ctrl+C interrupts as usual."""

    def handler(signum: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        callback()

    previous = replace_handlers(handler, [signal.SIGINT] if enabled else [])
    try:
        yield
    finally:
        restore_handlers(previous)
