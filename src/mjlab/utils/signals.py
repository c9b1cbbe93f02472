"""Scoped signal handlers: stop requests, the first Ctrl+C, signals for child processes.

A command that a signal ended exits with 128 + its number, as in a shell: 130 for SIGINT, 143 for SIGTERM.
While modules load and while Python shuts down, the signal itself ends the process: a shell shows the same
status, `subprocess` -2 and -15.

SIGHUP (closed terminal) does not exist on Windows. There, Ctrl-Break (SIGBREAK) takes the place of SIGINT
for processes of another group, which Ctrl-C does not reach.
"""

from __future__ import annotations

import _thread
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


def end_by_interrupt(enabled: bool) -> bool:
    """Let Ctrl-C end the process at once, as SIGTERM does, instead of raising KeyboardInterrupt, or not.

    KeyboardInterrupt would be printed with a traceback, or lost, while modules load and while Python
    shuts down. Other handlers are kept, and so are all outside the main thread. Returns True if the
    handler changed: a program may choose the same by itself.
    """
    actions = (signal.default_int_handler, signal.SIG_DFL)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) != actions[not enabled]:
        return False
    signal.signal(signal.SIGINT, actions[enabled])
    return True


class Interrupted(KeyboardInterrupt):
    """Stop signal that ended what was asked for. Commands exit with `exit_status`, without a message."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = signal.Signals(number)
        """Signal."""

    @property
    def exit_status(self) -> int:
        """128 + the number of the signal."""
        return 128 + self.number


def interrupting_signal(status: int) -> signal.Signals | None:
    """Return the stop signal that ended a process with exit status `status`; None if it was not one.

    A negative status is the signal whose default action ended the process, as `subprocess` has it.
    """
    number = -status if status < 0 else status - 128
    return signal.Signals(number) if number in FORWARDED else None


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


@contextlib.contextmanager
def raising_interrupted() -> Generator[None]:
    """Let stop signals raise `Interrupted` within the block, so that its temporary files are removed."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    with handled_signals(interrupt, FORWARDED):
        yield


class StopRequest:
    """Context manager: stop signals are requests, in two stages, instead of ending the process.

    The first SIGINT, SIGTERM or SIGHUP sets `number`: finish what is running, then save. The second
    signal, or the end of `grace`, raises `Interrupted` in blocks of `interruptible`: save what was
    finished before. A third has its usual effect. SIGHUP is ignored after the first signal, because
    a terminal and its shell both send it. A process that ignores SIGHUP, such as under `nohup`,
    keeps ignoring it. The end of the context restores the previous handlers. No effect outside the
    main thread, because only the main thread can handle signals.
    """

    def __init__(
        self, on_request: Callable[[str], None] | None = None, grace: float | None = None
    ) -> None:
        """Set up.

        Args:
            on_request: Function that receives the name of the first signal.
            grace: Time from the first signal to the second stage (s). None: unlimited.
        """
        self.number: signal.Signals | None = None
        """First signal. None: no signal has arrived."""
        self._on_request = on_request
        self._grace = grace
        self._previous: dict[int, Any] = {}
        self._timer: threading.Timer | None = None
        self._is_urgent = False
        self._is_interruptible = False

    @property
    def requested(self) -> bool:
        """True if a signal has arrived."""
        return self.number is not None

    @contextlib.contextmanager
    def interruptible(self, enabled: bool = True) -> Generator[None]:
        """Let the second stage raise `Interrupted` within the block; at once if it has begun."""
        self._is_interruptible = enabled
        try:
            if enabled and self.number is not None and self._is_urgent:
                raise Interrupted(self.number)
            yield
        finally:
            self._is_interruptible = False

    def __enter__(self) -> StopRequest:
        hangup = [] if _HANGUP is None else not_ignored([_HANGUP])
        others = hangup if _BREAK is None else [*hangup, _BREAK]
        self._previous = replace_handlers(self._handle, [signal.SIGINT, signal.SIGTERM, *others])
        return self

    def __exit__(self, *exception: object) -> None:
        self._is_interruptible = False
        if self._timer is not None:
            self._timer.cancel()
            self._timer.join()
        restore_handlers(self._previous)

    def _end_grace(self) -> None:
        # The main thread handles it as SIGTERM, without a signal to the process.
        if not self._is_urgent:
            _thread.interrupt_main(signal.SIGTERM)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = signal.Signals(number)
            if _HANGUP in self._previous:
                signal.signal(_HANGUP, signal.SIG_IGN)
            if self._grace is not None:
                self._timer = threading.Timer(self._grace, self._end_grace)
                self._timer.daemon = True
                self._timer.start()
            if self._on_request is not None:
                self._on_request(self.number.name)
            return
        self._is_urgent = True
        if self._timer is not None:
            self._timer.cancel()
        # The handler of SIGHUP follows at the end of the context.
        hangup = {n: old for n, old in self._previous.items() if n == _HANGUP}
        restore_handlers({n: old for n, old in self._previous.items() if n not in hangup})
        self._previous = hangup
        if self._is_interruptible:
            raise Interrupted(self.number)


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
