"""Trials: the interface of a family, and execution in separate processes.

A family is a module with

- `WHAT`: description of the trials,
- `TRIALS`: number of trials in 15 minutes,
- `LIMIT`: seconds per trial,
- `preload()`, if it needs more imports than `commands.preload`,
- `prepare(folder)`: returns data shared by all trials, as plain data; files go to `folder`,
- `run(trial, prepared)`: one trial; raises `Broken` if the contract is violated.

Family, number and seed determine a trial, so each can be repeated.
Processes are forked from one that has imported everything, because an import takes longer than most
trials.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import os
import pickle
import random
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

_SET_CHILD_SUBREAPER = 36
# Seconds for child processes of a command to end after it.
_GRACE = 2.0


class Broken(Exception):
    """Raised by a trial if the contract is violated; the text explains it in one line."""


@dataclass
class Trial:
    """One trial, within its process."""

    family: str
    number: int
    seed: int
    folder: Path
    """Working folder of the trial, removed afterwards."""
    what: str = ""
    """Description of the trial, for the line of a failure; see `trying`."""
    notes: list[str] = field(default_factory=list)
    """Remarks that are not failures."""
    rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self.rng = random.Random(f"{self.seed}/{self.family}/{self.number}")

    def trying(self, what: str) -> None:
        """Set the description of the trial, also for trials that do not finish."""
        self.what = what
        (self.folder.parents[3] / "what").write_text(what, "utf-8", "replace")


@dataclass(frozen=True)
class Verdict:
    """Outcome of a trial."""

    family: str
    number: int
    what: str = ""
    broken: str | None = None
    """Violation of the contract; None if it held."""
    notes: tuple[str, ...] = ()

    def line(self, seed: int) -> str:
        """Return the failure, and the command that repeats it, in one line."""
        text = " ".join(f"{self.what}: {self.broken}".split())
        return f"{text} (`make torture PARTS={self.family} SEED={seed} TRIAL={self.number}`)"


@dataclass
class Result:
    """Outcome of a family."""

    family: str
    seconds: float = 0.0
    tried: int = 0
    failed: list[Verdict] = field(default_factory=list)
    notes: collections.Counter[str] = field(default_factory=collections.Counter)


RESULTS = pytest.StashKey[list[Result]]()


def run_family(
    family: str,
    module: ModuleType,
    numbers: Sequence[int],
    seed: int,
    folder: Path,
    *,
    show: bool = False,
) -> Result:
    """Run the trials of a family, and print failures as they come."""
    result = Result(family)
    print(f"\n{family}: {module.WHAT} ({len(numbers)})", flush=True)
    begin = time.monotonic()
    for verdict in run_trials(family, module, numbers, seed, folder, show=show):
        result.tried += 1
        result.notes.update(verdict.notes)
        if verdict.broken is not None:
            result.failed.append(verdict)
            print(f"  failed: {verdict.line(seed)}", flush=True)
        elif show:
            print(f"  held: {verdict.what}", flush=True)
    result.seconds = time.monotonic() - begin
    result.failed.sort(key=lambda verdict: verdict.number)
    return result


def table(results: Sequence[Result], seed: int) -> str:
    """Return the numbers by family, the failures and the notes as Markdown."""
    lines = ["| family | tried | held | failed |", "| --- | ---: | ---: | ---: |"]
    tried = failed = 0
    for result in results:
        bad = len(result.failed)
        tried, failed = tried + result.tried, failed + bad
        lines.append(f"| {result.family} | {result.tried} | {result.tried - bad} | {bad} |")
    lines += [f"| all | {tried} | {tried - failed} | {failed} |", ""]
    took = ", ".join(f"{result.family} {result.seconds:.0f} s" for result in results)
    lines += [f"Seed {seed}. Took: {took}.", ""]
    for title, said in (
        ("Failed", [f"- {v.line(seed)}" for result in results for v in result.failed]),
        (
            "Noticed",
            [f"- {text} ({n} times)" for result in results for text, n in result.notes.items()],
        ),
    ):
        if said:
            lines += [f"{title}:", "", *said, ""]
    return "\n".join(lines)


def run_trials(
    family: str,
    module: ModuleType,
    numbers: Iterable[int],
    seed: int,
    folder: Path,
    *,
    workers: int = 2,
    show: bool = False,
) -> Iterator[Verdict]:
    """Run the trials of a family, `workers` at a time, and yield their outcomes, in any order.

    Raises:
        RuntimeError: preparation of shared data failed.
    """
    become_reaper()
    shared = folder / "shared"
    shared.mkdir(parents=True)
    getattr(module, "preload", lambda: None)()
    prepared = _prepared(module, shared)
    waiting = list(numbers)[::-1]
    running: dict[int, tuple[Trial, float]] = {}
    while waiting or running:
        while waiting and len(running) < workers:
            number = waiting.pop()
            own = folder / f"trial_{number}"
            # Relative paths with `..` stay in the trial's folder.
            trial = Trial(family, number, seed, own / "a/b/c/d")
            trial.folder.mkdir(parents=True)
            running[_fork_trial(trial, module, prepared, show)] = trial, time.monotonic()
        for pid, (trial, begin) in list(running.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            too_late = not ended and time.monotonic() - begin > module.LIMIT
            if too_late:
                orphans = end_descendants(pid)
                os.kill(pid, signal.SIGKILL)
                _reap([pid, *orphans])
            if ended or too_late:
                del running[pid]
                own = folder / f"trial_{trial.number}"
                yield _verdict(trial, own, status, module.LIMIT if too_late else None)
                shutil.rmtree(own, ignore_errors=True)
        time.sleep(0.005)


def _verdict(trial: Trial, own: Path, status: int, limit: float | None) -> Verdict:
    with contextlib.suppress(FileNotFoundError):
        return pickle.loads((own / "verdict").read_bytes())
    what = (own / "what").read_text("utf-8") if (own / "what").is_file() else "?"
    how = "the trial itself ended" if limit is None else f"no end after {limit:.0f} s"
    code = os.waitstatus_to_exitcode(status)
    return Verdict(trial.family, trial.number, what, how if limit else f"{how} with status {code}")


def _fork_trial(trial: Trial, module: ModuleType, prepared: Any, show: bool) -> int:
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    os.setsid()
    become_reaper()
    own = trial.folder.parents[3]
    if not show:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
    broken: str | None = None
    try:
        os.chdir(trial.folder)
        module.run(trial, prepared)
        left = _left_over()
        if left:
            broken = f"left {len(left)} processes running: {', '.join(left)}"
    except Broken as error:
        broken = str(error)
    except BaseException as error:
        traceback.print_exc()
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(frame.filename).name}:{frame.lineno}"
        broken = f"raised {type(error).__name__} at {place}: {_first_line(error)}"
    verdict = Verdict(trial.family, trial.number, trial.what, broken, tuple(trial.notes))
    (own / "draft").write_bytes(pickle.dumps(verdict))
    os.replace(own / "draft", own / "verdict")
    _reap(end_descendants(os.getpid()))
    os._exit(0)


def _prepared(module: ModuleType, folder: Path) -> Any:
    """Return the result of `module.prepare`, run in a separate process: threads do not survive a fork."""
    answer = folder.parent / "prepared"

    def prepare() -> None:
        os.chdir(folder)
        answer.write_bytes(pickle.dumps(module.prepare(folder)))

    output = folder.parent / "prepare.log"
    status = in_fork(prepare, output)
    if status != 0:
        raise RuntimeError(f"{module.__name__}.prepare failed:\n{output.read_text()[-3000:]}")
    return pickle.loads(answer.read_bytes())


def in_fork(function: Callable[[], None], output: Path) -> int:
    """Call `function` in a forked process whose output goes to a file; return the exit status."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    status = 1
    try:
        with open(output, "w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        function()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def become_reaper() -> None:
    """Adopt orphaned processes, so that they can be found."""
    ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def descendants(pid: int) -> list[int]:
    """Return the descendants of `pid`, without zombies."""
    children: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError):
                state, parent = (
                    Path(f"/proc/{entry}/stat").read_text().rsplit(")", 1)[1].split()[:2]
                )
                if state != "Z":
                    children.setdefault(int(parent), []).append(int(entry))
    found, ahead = [], [pid]
    while ahead:
        own = children.get(ahead.pop(), [])
        found += own
        ahead += own
    return found


def end_descendants(pid: int) -> list[int]:
    """Kill all processes below `pid`, and return them."""
    found = descendants(pid)
    for child in found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    return found


def _reap(pids: Iterable[int]) -> None:
    """Reap killed processes that are children of this one."""
    for pid in pids:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, 0)


def _left_over() -> list[str]:
    """Return the names of processes still running some time after all commands have ended."""
    end = time.monotonic() + _GRACE
    while (there := descendants(os.getpid())) and time.monotonic() < end:
        time.sleep(0.02)
    names = []
    for pid in there:
        with contextlib.suppress(OSError):
            names.append(Path(f"/proc/{pid}/comm").read_text().strip())
    return names


def name_of(function: Callable[..., Any]) -> str:
    """Return the name of a function as words."""
    return getattr(function, "__name__", "").strip("_").replace("_", " ")


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [""])[0][:200]
