"""Settings of a sweep: swept flags, their combinations, and the runs on disk."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.runs import Checkpoint, Run, runs_in
from mjlab.runs.run import DONE
from mjlab.sweep.objective import Objective
from mjlab.utils.errors import BadCallError
from mjlab.utils.string import is_number

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig

MAX_NAME = 80
"""Maximum length of the names of folders, without their digest."""

Setting = dict[str, str]
"""Values of the swept flags, as on the command line."""


@dataclass(frozen=True)
class Axis:
    """Swept flag with its values or its range."""

    name: str
    """Flag without dashes at its start, such as `agent.algorithm.learning-rate`."""
    text: str
    """Values or range, as on the command line."""
    values: tuple[str, ...]
    """Values; the ends of a range."""
    is_range: bool = False
    """Sample between the two values."""
    is_log: bool = False
    """Sample on a logarithmic scale."""
    is_integer: bool = False
    """Sample integers."""

    @classmethod
    def parse(cls, argument: str) -> Axis:
        """Return the axis of `--over argument`.

        Raises:
            BadCallError: the argument is not FLAG=VALUES, or the ends of a range are not in order.
        """
        name, equals, text = argument.partition("=")
        name = name.strip().lstrip("-").replace("_", "-")
        scale = text.removesuffix(":log")
        ends = tuple(scale.split(".."))
        if len(ends) == 2 and all(map(is_number, ends)):
            low, high = map(float, ends)
            is_log = scale != text
            if not low < high or (is_log and low <= 0.0):
                raise BadCallError(
                    f"--over {name}: expected LOW..HIGH with LOW < HIGH, and LOW > 0 for :log, got "
                    f"{text!r}."
                )
            return cls(name, text, ends, is_range=True, is_log=is_log)
        values = [value.strip() for value in _split(text)]
        if not name or not equals or not all(values):
            raise BadCallError(
                f"--over: expected FLAG=A,B,... or FLAG=LOW..HIGH, got {argument!r}; use e.g. "
                "--over agent.algorithm.learning-rate=1e-4,3e-4."
            )
        return cls(name, text, tuple(dict.fromkeys(values)))

    def value(self, text: str) -> str | int | float | None:
        """Return the value of the axis that is `text` on the command line; None: not of this axis."""
        if not self.is_range:
            return text if text in self.values else None
        low, high = map(float, self.values)
        with contextlib.suppress(ValueError):
            value = int(text) if self.is_integer else float(text)
            return value if low <= value <= high else None
        return None


def _split(text: str) -> Iterator[str]:
    """Yield the parts of `text` between commas outside brackets."""
    depth, begin = 0, 0
    for position, character in enumerate(text):
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            yield text[begin:position]
            begin = position + 1
    yield text[begin:]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Settings to compare."""

    task: str
    """Name of the task."""
    axes: tuple[Axis, ...]
    """Swept flags."""
    flags: tuple[str, ...]
    """Flags of all runs."""
    machine_flags: tuple[str, ...]
    """Flags of all runs that select devices of this machine."""
    seeds: int
    """Number of seeds per setting."""
    trials: int | None
    """Number of settings to sample. None: all combinations."""
    jobs: int | None
    """Number of runs side by side. None: as many as the machine suits."""
    folder: Path
    """Folder of the sweep."""
    storage: str | None
    """URL of a database or proxy, or path of a journal file. None: SQLite file in the folder."""
    objective: Objective = Objective()
    """Value to compare."""

    @property
    def combinations(self) -> list[Setting]:
        """All combinations of the values; of ranges, the ends."""
        names = [axis.name for axis in self.axes]
        products = itertools.product(*(axis.values for axis in self.axes))
        return [dict(zip(names, values, strict=True)) for values in products]

    @property
    def begun(self) -> list[Setting]:
        """Settings that runs of the folder record, the first started first."""
        runs = [run for path in (self.folder / "runs").glob("*/") for run in runs_in(path)]
        found = []
        for run in sorted(runs, key=lambda run: run.started or datetime.min):
            words = run.info.get("command")
            words = [w for w in words if isinstance(w, str)] if isinstance(words, list) else []
            flags = dict(word[2:].split("=", 1) for word in words if re.match("--.*=", word))
            setting = {axis.name: flags.get(axis.name, "") for axis in self.axes}
            values = [axis.value(setting[axis.name]) for axis in self.axes]
            if None not in values and setting not in found:
                found.append(setting)
        return found

    @property
    def num_settings(self) -> int:
        """Number of settings on all machines."""
        return len(self.combinations) if self.trials is None else self.trials

    @property
    def definition(self) -> dict[str, Any]:
        """Properties that stay the same while a sweep continues."""
        over = {axis.name: axis.text for axis in self.axes}
        return {"task": self.task, "over": over, "flags": [*self.flags]}

    def short(self, name: str) -> str:
        """Return the last part of a swept flag, or the flag if two have the same last part."""
        last = name.rpartition(".")[2]
        return (
            last if [axis.name.rpartition(".")[2] for axis in self.axes].count(last) == 1 else name
        )

    def describe(self, setting: Setting) -> str:
        """Return a setting as text: `learning-rate=1e-4, gamma=0.99`."""
        return ", ".join(f"{self.short(name)}={value}" for name, value in setting.items())

    def runs_folder(self, setting: Setting) -> Path:
        """Return the folder of the runs of a setting."""
        name = self.describe(setting).replace(", ", ",")
        clean = re.sub(r"[^\w.=,+-]", "_", name, flags=re.ASCII)
        if clean != name or len(clean) > MAX_NAME:
            clean = f"{clean[:MAX_NAME]}-{digest(name)}"
        return self.folder / "runs" / clean

    def log_file(self, setting: Setting, seed: int) -> Path:
        """Return the file with the output of a run."""
        return self.runs_folder(setting) / f"seed_{seed}.log"

    def sessions(self, setting: Setting, seed: int) -> list[Run]:
        """Return the sessions of a seed, the newest first."""
        return runs_in(self.runs_folder(setting), run_name=f"seed_{seed}")

    def finished_run(self, setting: Setting, seed: int) -> Run | None:
        """Return the last session of a run that was trained to its end; None for others.

        A run interrupted in its last iteration lacks the last evaluation.
        """
        runs = self.sessions(setting, seed)
        return next((run for run in runs if run.info.get("ended") in DONE), None)

    def last_checkpoint(self, setting: Setting, seed: int) -> Checkpoint | None:
        """Return the checkpoint to resume a run from: the newest with iterations left."""
        total = train_config(self, setting).agent.max_iterations
        saved = (c for run in self.sessions(setting, seed) for c in reversed(run.checkpoints))
        return next((c for c in saved if c.number is not None and c.number + 1 < total), None)


def digest(text: str) -> str:
    """Return six hexadecimal digits that identify a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:6]


def train_flags(sweep: Sweep, setting: Setting) -> list[str]:
    """Return the flags of `train` for a setting, as the user would type them, without the device."""
    return [*sweep.flags, *(f"--{name}={value}" for name, value in setting.items())]


def train_config(sweep: Sweep, setting: Setting) -> TrainConfig:
    """Return the config that `train` reads from the flags of a setting; exits on invalid flags."""
    flags = (*train_flags(sweep, setting), *sweep.machine_flags)
    return parse_train(sweep.task, flags, "mjlab sweep")


@functools.cache
def parse_train(task: str, flags: tuple[str, ...], prog: str) -> TrainConfig:
    """Return the config of `train`; exits on invalid flags, and on `--help`."""
    from mjlab.cli.train_config import parse_train_flags

    return parse_train_flags(task, [*flags], f"{prog} {task}")
