"""Folder of a run: creation, and the files that training writes besides checkpoints and events."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
from collections.abc import Callable, Generator
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

from mjlab.runs.run import INFO_FILE, RUNNING_FILE, TIME_FORMAT, Run, runs_in
from mjlab.utils.os import create_locked, dump_yaml, remove_temporary_files, replacing, to_plain
from mjlab.utils.signals import FORWARDED, replace_handlers, restore_handlers


class NewRunFolder:
    """Context manager that creates the folder of a run: `<experiment>/<time>[_<run name>]`.

    On exit the folder and its content are removed, unless `keep` was called: a run that fails before
    its start leaves no folder.
    """

    def __init__(self, experiment: Path, run_name: str) -> None:
        self._experiment = experiment
        self._run_name = run_name
        self.is_kept = False
        """True once the run has started."""
        self.path = experiment
        """Run folder. Exists once the context is entered."""

    def keep(self) -> None:
        """Keep the folder on exit: the run has started."""
        self.is_kept = True

    def __enter__(self) -> NewRunFolder:
        """Create the folder.

        Raises:
            RunFolderError: the folder cannot be created or written.
        """
        from mjlab.rl.checkpoint import ensure_writable_folder

        ensure_writable_folder(self._experiment)
        # Killed runs leave temporary files.
        for run in runs_in(self._experiment):
            for folder in (run.folder, run.folder / "params", *run.folder.glob("videos/*")):
                remove_temporary_files(folder)
        name = datetime.now().strftime(TIME_FORMAT)
        if self._run_name:
            name += f"_{self._run_name}"
        self.path, number = self._experiment / name, 2
        while True:
            # mkdir claims the name atomically: another run may start in the same second.
            try:
                self.path.mkdir(parents=True)
            except FileExistsError:
                self.path, number = self._experiment / f"{name}-{number}", number + 1
            else:
                # The lock ends with the process, however it ends.
                self._running = create_locked(self.path / RUNNING_FILE)
                return self

    def __exit__(self, *exception: object) -> None:
        self._running.close()
        (self.path / RUNNING_FILE).unlink(missing_ok=True)
        # Never remove checkpoints.
        if not self.is_kept and not Run(self.path).checkpoints:
            shutil.rmtree(self.path, ignore_errors=True)


@contextlib.contextmanager
def exit_by_signal(unless: Callable[[], bool]) -> Generator[None]:
    """Convert SIGTERM and SIGHUP to SystemExit within the block, so that the block cleans up.

    If `unless` returns True, the default action runs. Signals already handled or ignored are unchanged,
    and so are all signals outside the main thread.
    """
    previous: dict[int, Any] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        restore_handlers(previous)
        if unless():
            os.kill(os.getpid(), number)
            return
        # Unlike print, also while the interrupted code is printing.
        name = signal.Signals(number).name
        os.write(2, f"{name}: stopped before the first iteration.\n".encode())
        raise SystemExit(128 + number)

    ending = [n for n in FORWARDED if n != signal.SIGINT and signal.getsignal(n) is signal.SIG_DFL]
    previous |= replace_handlers(handle, ending)
    try:
        yield
    finally:
        # Keep handlers installed within the block.
        restore_handlers({n: old for n, old in previous.items() if signal.getsignal(n) is handle})


class SharedRunFolder:
    """Run folder in processes other than the first, with the interface of `NewRunFolder` they need."""

    def __init__(self, path: Path) -> None:
        self.path = path
        """Run folder created by the first process."""

    def keep(self) -> None:
        """Do nothing: the first process decides."""


def write_info(run_dir: Path, **info: Any) -> None:
    """Add entries to the metadata of a run (`run.json`)."""
    text = json.dumps(to_plain({**Run(run_dir).info, **info}), indent=2)
    with replacing(run_dir / INFO_FILE) as file:
        file.write(f"{text}\n".encode())


def resumed_entry(run_dir: Path, checkpoint: Path) -> str:
    """Return the path of the checkpoint that a run resumes, as recorded in its metadata.

    Paths are relative within an experiment, so that its folder can be moved.
    """
    experiment = run_dir.resolve().parent
    path = checkpoint.resolve()
    return str(path.relative_to(experiment) if path.is_relative_to(experiment) else path)


def write_params(run_dir: Path, env: Any, agent: Any) -> None:
    """Write the configs of a run, for users and for `Run.params`."""
    dump_yaml(run_dir / "params" / "env.yaml", dataclasses.asdict(env))
    dump_yaml(run_dir / "params" / "agent.yaml", dataclasses.asdict(agent))
