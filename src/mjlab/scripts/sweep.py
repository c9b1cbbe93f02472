"""Train and compare settings of a task: `uv run mjlab sweep TASK --over FLAG=VALUES [flags of train]`.

Optuna stores the settings ("trials") and their values in a database, suggests values of ranges, and shares
trials between machines. Each seed of a setting is a process of `train`:

    logs/sweeps/<name>/
        study.db                              Optuna's database, unless --storage names another
        runs/<setting>/<time>_seed_<n>/       run folders
        runs/<setting>/seed_<n>.log           their output
        table.csv, table.md, curves.png       comparison

The same command continues a sweep: finished runs are kept, others resume from their checkpoints.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import itertools
import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.scripts.flags import is_given
from mjlab.scripts.help import lookup
from mjlab.scripts.reference import ENDED
from mjlab.scripts.run_folder import checkpoints_in, read_run_info, runs_named
from mjlab.scripts.train_seeds import read_count
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.string import counted

if TYPE_CHECKING:
    from mjlab.scripts.train_config import TrainConfig

ROOT = Path("logs/sweeps")
"""Folder of all sweeps."""
EVALUATED = "Evaluation/mean_return"
"""Default objective of tasks with evaluations: mean return of the last evaluation."""
EXPLORED = "Train/exploring_return"
"""Default objective of other tasks: return of the exploring episodes."""

# Flags that the sweep sets, and alternatives.
_RESERVED = {
    "--agent.seed": "--seeds N",
    "--agent.run-name": "--folder DIR",
    "--agent.experiment-name": "--folder DIR",
    "--log-root": "--folder DIR",
    "--agent.resume": "the same command again, which resumes interrupted runs",
    "--agent.load-run": "`train` for one run",
    "--agent.load-checkpoint": "`train` for one run",
    "--wandb-run-path": "`train` for one run",
}
# Flags of this machine, the same for all settings.
_MACHINE = ("--device", "--gpu-ids")
# Episodes without a time limit have no return.
_LONGEST_EPISODE_S = 1e6
_MAX_NAME = 80

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
        if len(ends) == 2 and all(map(_is_number, ends)):
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


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
    """URL of the database. None: SQLite file in the folder."""
    objective: str | None
    """TensorBoard tag to compare. None: default of the task."""
    minimize: bool
    """Prefer low values of the objective."""

    @property
    def combinations(self) -> list[Setting]:
        """All combinations of the values; of ranges, the ends."""
        names = [axis.name for axis in self.axes]
        products = itertools.product(*(axis.values for axis in self.axes))
        return [dict(zip(names, values, strict=True)) for values in products]

    @property
    def num_settings(self) -> int:
        """Number of settings on all machines."""
        return len(self.combinations) if self.trials is None else self.trials

    @property
    def definition(self) -> dict[str, Any]:
        """Properties that stay the same while a sweep continues."""
        over = {axis.name: axis.text for axis in self.axes}
        return {"task": self.task, "over": over, "flags": [*self.flags]}

    @property
    def label(self) -> str:
        """Objective without its group, `mean_return`."""
        assert self.objective is not None
        return self.objective.rpartition("/")[2]

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
        if clean != name or len(clean) > _MAX_NAME:
            clean = f"{clean[:_MAX_NAME]}-{_digest(name)}"
        return self.folder / "runs" / clean

    def log_file(self, setting: Setting, seed: int) -> Path:
        """Return the file with the output of a run."""
        return self.runs_folder(setting) / f"seed_{seed}.log"

    def sessions(self, setting: Setting, seed: int) -> list[Path]:
        """Return the run folders of a seed, the newest first."""
        return runs_named(self.runs_folder(setting), f"seed_{seed}")

    def finished_run(self, setting: Setting, seed: int) -> Path | None:
        """Return the last session of a run that was trained to its end; None for others.

        A run interrupted in its last iteration lacks the last evaluation.
        """
        runs = self.sessions(setting, seed)
        return next((run for run in runs if read_run_info(run).get("ended") in ENDED), None)

    def last_checkpoint(self, setting: Setting, seed: int) -> Path | None:
        """Return the checkpoint to resume a run from: the newest with iterations left."""
        total = train_config(self, setting).agent.max_iterations
        for run in self.sessions(setting, seed):
            for checkpoint in reversed(checkpoints_in(run)):
                if int(checkpoint.stem.removeprefix("model_")) + 1 < total:
                    return checkpoint
        return None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:6]


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab sweep`."""
    sweep = parse_sweep(argv, prog)
    # Imports Optuna; flags are checked before.
    from mjlab.scripts.sweep_results import Comparison
    from mjlab.scripts.sweep_runs import Runs, Study, only_process

    with only_process(sweep.folder):
        study = Study(sweep)
        runs = Runs(sweep, study)
        runs.train()
        Comparison(sweep, study).report()
    words = ["uv", "run", *prog.split(), *argv]
    line = subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)
    if runs.interrupted:
        print(f"Interrupted; finished runs are kept. To continue:\n    {line}")
        raise KeyboardInterrupt
    if runs.failed:
        logs = ", ".join(map(str, runs.failed[:3]))
        raise UserError(
            f"{counted(len(runs.failed), 'run')} failed; output: {logs}. To retry:\n    {line}"
        )


def parse_sweep(argv: list[str], prog: str) -> Sweep:
    """Return the sweep of a command line. Exits on an unknown flag, and on `--help`.

    Every setting is checked by the parser of `train`.

    Raises:
        BadCallError, UserError, ValueError: a flag is invalid; the message names it.
    """
    task, *words = argv
    parser = argparse.ArgumentParser(prog=f"{prog} {task}", add_help=False, allow_abbrev=False)
    parser.add_argument("--over", action="append", default=[])
    parser.add_argument("--minimize", action="store_true")
    for flag in (
        "--seeds",
        "--trials",
        "--jobs",
        "--folder",
        "--storage",
        "--objective",
        *_MACHINE,
    ):
        parser.add_argument(flag)
    args, flags = parser.parse_known_args(words)
    if "-h" in flags or "--help" in flags:
        print(f"`{prog} --help` shows the flags of the sweep. All others are those of `train`:\n")
        _parse_train(task, tuple(flags), prog)
    axes = tuple(map(Axis.parse, args.over))
    counts = {
        name: None if text is None else read_count(f"--{name}", text)
        for name, text in (("seeds", args.seeds), ("trials", args.trials), ("jobs", args.jobs))
    }
    _check_axes(axes, flags, counts["trials"])
    machine = [(flag, getattr(args, flag[2:].replace("-", "_"))) for flag in _MACHINE]
    sweep = Sweep(
        task=task,
        axes=axes,
        flags=tuple(flags),
        machine_flags=tuple(word for flag, value in machine if value for word in (flag, value)),
        seeds=counts["seeds"] or 1,
        trials=counts["trials"],
        jobs=counts["jobs"],
        folder=ROOT,
        storage=args.storage,
        objective=args.objective,
        minimize=args.minimize,
    )
    cfg = check_settings(sweep)
    return dataclasses.replace(
        sweep,
        axes=tuple(_with_type(axis, cfg) for axis in axes),
        folder=Path(args.folder or ROOT / _name(sweep)),
        objective=args.objective or default_objective(cfg),
    )


def _check_axes(axes: tuple[Axis, ...], flags: list[str], trials: int | None) -> None:
    """Raise BadCallError for flags that cannot be swept together."""
    if not axes:
        raise BadCallError(
            "sweep: expected at least one --over FLAG=A,B,..., got none; use e.g. --over "
            "agent.algorithm.learning-rate=1e-4,3e-4, or `train-seeds` for one setting."
        )
    names = [f"--{axis.name}" for axis in axes]
    for name in names:
        if names.count(name) > 1 or is_given(name, flags):
            raise BadCallError(f"{name}: expected one --over or one value, got both or several.")
        if name in _MACHINE:
            raise BadCallError(f"--over {name[2:]}: expected the same for all runs; use {name}.")
    for flag, use in _RESERVED.items():
        if flag in names or is_given(flag, flags):
            raise BadCallError(f"{flag}: expected no value, because the sweep sets it; use {use}.")
    ranges = [axis.name for axis in axes if axis.is_range]
    if ranges and trials is None:
        raise BadCallError(
            f"--over {ranges[0]}: expected --trials with a range, got none; use e.g. --trials 20."
        )


def check_settings(sweep: Sweep) -> TrainConfig:
    """Parse every combination of values as `train` would; return the config of the first.

    Of ranges, the ends are checked.
    """
    from mjlab.scripts.train_config import check_flags, check_typed_flags

    first: TrainConfig | None = None
    for setting in sweep.combinations:
        flags = [*train_flags(sweep, setting), *sweep.machine_flags]
        cfg = train_config(sweep, setting)
        try:
            check_typed_flags(cfg, flags)
            check_flags(cfg)
        except (UserError, ValueError) as error:
            raise BadCallError(f"{error} (In the setting {sweep.describe(setting)}.)") from error
        first = first or cfg
    assert first is not None
    return first


def train_flags(sweep: Sweep, setting: Setting) -> list[str]:
    """Return the flags of `train` for a setting, as the user would type them, without the device."""
    return [*sweep.flags, *(f"--{name}={value}" for name, value in setting.items())]


def train_config(sweep: Sweep, setting: Setting) -> TrainConfig:
    """Return the config that `train` reads from the flags of a setting; exits on invalid flags."""
    flags = (*train_flags(sweep, setting), *sweep.machine_flags)
    return _parse_train(sweep.task, flags, "mjlab sweep")


@functools.cache
def _parse_train(task: str, flags: tuple[str, ...], prog: str) -> TrainConfig:
    from mjlab.scripts.train import parse_train_flags

    return parse_train_flags(task, [*flags], f"{prog} {task}")


def _with_type(axis: Axis, cfg: TrainConfig) -> Axis:
    """Return the axis of a range with the type of the flag: integer or real."""
    value = lookup(cfg, axis.name)[1]
    # Short forms are None by default.
    literals = all(re.fullmatch(r"[+-]?\d+", end) for end in axis.values)
    is_integer = isinstance(value, int) if isinstance(value, (int, float)) else literals
    return dataclasses.replace(axis, is_integer=axis.is_range and is_integer)


def _name(sweep: Sweep) -> str:
    """Return the folder name of a sweep: the same for the same task, --over and flags."""
    keys = "_".join(sweep.short(axis.name) for axis in sweep.axes)
    return f"{sweep.task}_{keys}"[:_MAX_NAME] + f"_{_digest(repr(sweep.definition))}"


def default_objective(cfg: TrainConfig) -> str:
    """Return the tag to compare: of evaluations if the task has them, else the exploring return."""
    from mjlab.rl.evaluation import Bound
    from mjlab.rl.plot import DEFAULT_TAG

    if Bound.all_of(vars(cfg.agent.evaluation)):
        return EVALUATED
    return EXPLORED if cfg.env.episode_length_s < _LONGEST_EPISODE_S else DEFAULT_TAG
