"""Run folders: creation, run metadata, and checkpoint lookup."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import shutil
import signal
from collections.abc import Callable, Generator
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import dump_yaml, remove_temporary_files, replacing
from mjlab.utils.signals import FORWARDED, replace_handlers, restore_handlers

_INFO_FILE = "run.json"
_CHECKPOINT = re.compile(r"model_(\d+)\.pt")


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
        for run_dir in run_folders(self._experiment):
            for folder in (run_dir, run_dir / "params", *run_dir.glob("videos/*")):
                remove_temporary_files(folder)
        name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
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
                return self

    def __exit__(self, *exception: object) -> None:
        # Never remove checkpoints.
        if not self.is_kept and not checkpoints_in(self.path):
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
        print_notice(f"{signal.Signals(number).name}: stopped before the first iteration.")
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


def write_run_info(run_dir: Path, **info: Any) -> None:
    """Add entries to the metadata of a run (`run.json`)."""
    text = json.dumps({**read_run_info(run_dir), **info}, indent=2)
    with replacing(run_dir / _INFO_FILE) as file:
        file.write(f"{text}\n".encode())


def write_resumed(run_dir: Path, checkpoint: Path) -> None:
    """Record in the metadata of a run that it resumes `checkpoint`."""
    experiment = run_dir.resolve().parent
    checkpoint = checkpoint.resolve()
    # Relative path, so that the folder of an experiment can be moved.
    is_beside = checkpoint.is_relative_to(experiment)
    path = checkpoint.relative_to(experiment) if is_beside else checkpoint
    write_run_info(run_dir, resumed=str(path))


def sessions_of(run_dir: Path) -> list[Path]:
    """Return the folders of a run that was resumed, from its first session to `run_dir`.

    Raises:
        UserError: folder of an earlier session not found.
    """
    sessions = [run_dir.resolve()]
    while (resumed := read_run_info(sessions[0]).get("resumed")) is not None:
        # `/` also handles an absolute `resumed`.
        earlier = (sessions[0].parent / str(resumed)).parent
        if not earlier.is_dir() or earlier in sessions:
            raise UserError(
                f"{sessions[0] / _INFO_FILE} resumed: expected the folder of an earlier session, "
                f"got {str(resumed)!r}; put that folder back."
            )
        sessions.insert(0, earlier)
    return sessions


def is_run_folder(folder: Path) -> bool:
    """Return True if `folder` was created by training, not just used to store policies."""
    return (folder / _INFO_FILE).is_file() or (folder / "params").is_dir()


def read_run_info(run_dir: Path) -> dict[str, Any]:
    """Return the metadata of a run; empty if missing or unreadable."""
    try:
        info = json.loads((run_dir / _INFO_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return info if isinstance(info, dict) else {}


def write_params(run_dir: Path, env: Any, agent: Any) -> None:
    """Write the configs of a run, for users and for `read_params`."""
    dump_yaml(run_dir / "params" / "env.yaml", dataclasses.asdict(env))
    dump_yaml(run_dir / "params" / "agent.yaml", dataclasses.asdict(agent))


def read_params(run_dir: Path, name: Literal["env", "agent"]) -> dict[str, Any]:
    """Return the environment or learner config of a run; empty if missing or unreadable."""
    import yaml

    try:
        params = yaml.safe_load((run_dir / "params" / f"{name}.yaml").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return {}
    return params if isinstance(params, dict) else {}


def checkpoints_in(run_dir: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest iteration first."""
    named = (path for path in run_dir.glob("model_*.pt") if _CHECKPOINT.fullmatch(path.name))
    return sorted(named, key=_number)


def _number(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("model_"))


def newest_checkpoint(experiment: Path, task: str, learner: str | None = None) -> Path | None:
    """Return the last checkpoint of the newest run of `task` with checkpoints; None if not found.

    `learner` restricts the search to runs of that learner.
    """
    for run_dir in run_folders(experiment):
        # Runs of other tools do not record their task, and match any task.
        info = read_run_info(run_dir)
        if info.get("task", task) == task and learner in (None, info.get("learner", learner)):
            checkpoints = checkpoints_in(run_dir)
            if checkpoints:
                return checkpoints[-1]
    return None


def resolve_checkpoint(path: Path, task: str) -> Path:
    """Return the checkpoint at `path`. The path may omit the run folder.

    `logs/rsl_rl/cartpole/model_500.pt` then refers to that file of the newest run of `task`, or to the
    last checkpoint of that run if it was solved or finished before iteration 500.

    Raises:
        UserError: file not found; the message lists the available checkpoints.
    """
    if path.is_file():
        return path
    match = _CHECKPOINT.fullmatch(path.name)
    newest = newest_checkpoint(path.parent, task) if match else None
    if match and newest:
        sibling = newest.parent / path.name
        if sibling.is_file():
            return sibling
        ended = read_run_info(newest.parent).get("ended")
        if ended in ("solved", "finished") and int(match.group(1)) > _number(newest):
            print_notice(
                f"The newest run was {ended} before {path.name}. Its last checkpoint: {newest}"
            )
            return newest
    folders = [path.parent, *run_folders(path.parent)[:1]]
    available = [str(file) for folder in folders for file in checkpoints_in(folder)[-3:]]
    hint = f"Available: {', '.join(available)}." if available else f"Use `train {task}` first."
    raise UserError(f"Checkpoint {path} not found. {hint}")


def runs_named(experiment: Path, run_name: str) -> list[Path]:
    """Return the run folders that `NewRunFolder` created for `run_name`, in the order of `run_folders`."""
    pattern = re.compile(rf".*_{re.escape(run_name)}(-\d+)?")
    return [run_dir for run_dir in run_folders(experiment) if pattern.fullmatch(run_dir.name)]


def run_folders(experiment: Path) -> list[Path]:
    """Return the run folders of an experiment, most recently changed checkpoints first.

    Ties, and runs without checkpoints, are sorted by name, i.e. by start time.
    """
    if not experiment.is_dir():
        return []

    def last_change(run_dir: Path) -> int:
        return max((path.stat().st_mtime_ns for path in checkpoints_in(run_dir)), default=0)

    runs = [path for path in experiment.iterdir() if path.is_dir()]
    return sorted(runs, key=lambda run: (last_change(run), run.name), reverse=True)
