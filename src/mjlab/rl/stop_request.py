"""Ctrl-C and SIGTERM ask training to stop after the running iteration; a second one kills."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """A context in which SIGINT and SIGTERM set `signal_name` instead of ending the process.

    The handlers that were there before come back with the first signal, so that a second one does
    what it always did, and at the end of the context. Outside the main thread, which alone can
    handle signals, nothing is changed.
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
            for number in _SIGNALS:
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        self._restore_handlers()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.signal_name = signal.Signals(number).name
        self._restore_handlers()
        if self._on_request is not None:
            self._on_request(self.signal_name)

    def _restore_handlers(self) -> None:
        while self._previous:
            number, handler = self._previous.popitem()
            # A handler that was not set from Python reads as None and cannot be set again.
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
