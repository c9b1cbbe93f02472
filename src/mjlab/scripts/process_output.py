"""What the processes of a run print: the first to the terminal, the others to files."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
from collections.abc import Generator
from pathlib import Path
from typing import IO

from mjlab.utils.processes import ProcessRank

# Under this name the reference's launcher has it.
LOG_DIR_VARIABLE = "TORCHRUNX_LOG_DIR"


class ProcessOutput(io.TextIOBase):
    """Takes what a process prints, and writes it to a file once it is told which."""

    def __init__(self) -> None:
        self._target: IO[str] | None = io.StringIO()

    def writable(self) -> bool:
        """Whether this can be written to."""
        return True

    def write(self, text: str) -> int:
        """Take `text`; return its length."""
        if self._target is not None:
            self._target.write(text)
            self._target.flush()
        return len(text)

    def keep_in(self, path: Path | None) -> None:
        """Write to `path` from now on, and what was printed before, too; None: drop it all."""
        before = self._target.getvalue() if isinstance(self._target, io.StringIO) else ""
        self._target = None
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._target = path.open("w", encoding="utf-8")
            self.write(before)

    def release(self) -> None:
        """Close the file."""
        if self._target is not None:
            self._target.close()
            self._target = None


@contextlib.contextmanager
def output_of(rank: ProcessRank) -> Generator[ProcessOutput | None]:
    """Take, within the block, what a process other than the first prints; None for the first.

    An error that ends the block is not among it: whoever prints it prints it to the terminal.
    """
    if rank.is_first:
        yield None
        return
    output = ProcessOutput()
    handlers = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stderr
    ]
    terminal = sys.stderr
    for handler in handlers:
        handler.setStream(output)
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            yield output
    finally:
        for handler in handlers:
            handler.setStream(terminal)
        output.release()


def log_file(rank: ProcessRank, asked: str | None, run_dir: Path) -> Path | None:
    """Return the file for what a process prints: below TORCHRUNX_LOG_DIR, else `asked`, else
    `<run>/torchrunx`. None where that is empty: it is dropped then."""
    folder = os.environ.get(LOG_DIR_VARIABLE, asked)
    if folder is None:
        folder = str(run_dir / "torchrunx")
    return Path(folder) / f"rank_{rank.rank}.log" if folder else None
