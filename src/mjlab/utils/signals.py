"""Signal handlers that are restored when their block ends: stop requests and the first Ctrl+C."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Generator, Iterable
from types import FrameType
from typing import Any

# Not on every system: SIGHUP, which a closed terminal sends.
_HANGUP = getattr(signal, "SIGHUP", None)


class StopRequest:
    """A context in which SIGINT, SIGTERM and SIGHUP set `signal_name` instead of ending the process.

    The handlers that were there before come back with the first signal, so that a second one does
    what it always did, and at the end of the context. A second SIGHUP is ignored until then, because
    a terminal and its shell both send one. A process that ignores SIGHUP, such as one under `nohup`,
    goes on doing so. Outside the main thread, which alone can handle signals, nothing is changed.
    """

    def __init__(self, on_request: Callable[[str], None] | None = None) -> None:
        """`on_request` is called with the name of the signal when it arrives."""
        self.signal_name: str | None = None
        self._on_request = on_request
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether a signal has arrived."""
        return self.signal_name is not None

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            numbers = [signal.SIGINT, signal.SIGTERM]
            if _HANGUP is not None and signal.getsignal(_HANGUP) is not signal.SIG_IGN:
                numbers.append(_HANGUP)
            for number in numbers:
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        self._restore_handlers()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.signal_name = signal.Signals(number).name
        self._restore_handlers(without=_HANGUP)
        if _HANGUP in self._previous:
            signal.signal(_HANGUP, signal.SIG_IGN)
        if self._on_request is not None:
            self._on_request(self.signal_name)

    def _restore_handlers(self, without: int | None = None) -> None:
        for number in [number for number in self._previous if number != without]:
            handler = self._previous.pop(number)
            # A handler that was not set from Python reads as None and cannot be set again.
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


@contextlib.contextmanager
def handled_signals(
    handle: Callable[[int, FrameType | None], None], numbers: Iterable[int]
) -> Generator[None]:
    """Call `handle` for the signals `numbers` within the block, then restore the handlers.

    Ignored signals, such as SIGHUP under `nohup`, stay ignored.
    """
    previous = {
        number: signal.signal(number, handle)
        for number in numbers
        if signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            # A handler that was not set from Python reads as None and cannot be set again.
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


@contextlib.contextmanager
def first_interrupt_calls(callback: Callable[[], None], enabled: bool) -> Generator[None]:
    """Let the first Ctrl+C call `callback`, and a second one interrupt as usual."""
    if not enabled or threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.getsignal(signal.SIGINT)

    def handler(signum: int, frame: Any) -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        callback()

    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
