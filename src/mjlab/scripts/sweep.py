"""Train and compare settings of a task: `uv run mjlab sweep TASK --over FLAG=VALUES [flags of train]`.

Optuna stores the settings ("trials") and their values, suggests values of ranges, and shares
trials between machines. Each seed of a setting is a process of `train`:

    logs/sweeps/<name>/
        study.db                              Optuna's database, unless --storage names another
        runs/<setting>/<time>_seed_<n>/       run folders
        runs/<setting>/seed_<n>.log           their output
        table.csv, table.md, curves.png       comparison

The same command continues a sweep: finished runs are kept, others resume from their checkpoints.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjlab.cli.flags import is_given, parse_own_flags, typed_values
from mjlab.cli.help import lookup, requested_topic
from mjlab.cli.train_config import (
    TrainConfig,
    check_flags,
    check_typed_flags,
    report_moved_goal,
)
from mjlab.sweep.objective import choose_objective
from mjlab.sweep.settings import (
    MAX_NAME,
    Axis,
    Sweep,
    digest,
    parse_train,
    train_config,
    train_flags,
)
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.ranges import Range
from mjlab.utils.signals import Interrupted
from mjlab.utils.string import command_line, counted

ROOT = Path("logs/sweeps")
"""Folder of all sweeps."""

# Flags that the sweep sets, and alternatives.
_RESERVED = {
    "--seed": "--seeds N",
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


_Number = Annotated[int, Range(1, 10_000)]


@dataclass
class SweepFlags:
    """Flags of `sweep`. All others are those of `train`."""

    over: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FLAG=VALUES")
    ] = ()
    """Values of a flag of `train`: FLAG=A,B,...; a range to sample from: FLAG=LOW..HIGH, or FLAG=LOW..HIGH:log on
    a logarithmic scale. Several --over: all combinations."""
    trials: _Number | None = None
    """Number of settings to sample. Required for ranges."""
    seeds: _Number = 1
    """Number of seeds 1, 2, ... of each setting."""
    jobs: _Number | None = None
    """Runs side by side. None: one per GPU, else one per CPU core."""
    folder: str | None = None
    """Folder of the sweep. None: logs/sweeps/<task and flags>."""
    storage: str | None = None
    """Shared by machines: URL of a database, grpc://HOST:PORT of Optuna's proxy, or path of its journal
    file. None: SQLite file in the folder."""
    objective: str | None = None
    """TensorBoard tag to compare. None: last evaluation, else return; if settings change rewards, the
    success rate or metrics."""
    minimize: bool = False
    """Prefer low values of the objective."""
    device: str | None = None
    """Torch device: cpu, cuda:0, ... None: GPUs if available."""
    gpu_ids: str | None = None
    """GPUs to use, one run each, such as [0,2]. None: all."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab sweep`."""
    sweep = parse_sweep(argv, prog)
    # Imports Optuna; flags are checked before.
    from mjlab.sweep.results import Comparison
    from mjlab.sweep.runs import Runs
    from mjlab.sweep.storage import STORAGE_ERRORS, naming_storage
    from mjlab.sweep.study import Study, only_process

    with only_process(sweep.folder), naming_storage(sweep, *STORAGE_ERRORS):
        study = Study(sweep)
        runs = Runs(sweep, study)
        runs.train()
        Comparison(sweep, study).report()
    line = command_line(["uv", "run", *prog.split(), *argv])
    if runs.stopped_by is not None:
        print(f"Interrupted; {runs.what_is_left()}. To continue:\n    {line}")
        raise Interrupted(runs.stopped_by)
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
    own, flags = parse_own_flags(SweepFlags(), words, f"{prog} {task}")
    if requested_topic(flags) is not None:
        parse_train(task, tuple(flags), prog)
    axes = tuple(map(Axis.parse, own.over))
    _check_axes(axes, flags, own.trials)
    machine = (("--device", own.device), ("--gpu-ids", own.gpu_ids))
    sweep = Sweep(
        task=task,
        axes=axes,
        flags=tuple(flags),
        machine_flags=tuple(word for flag, value in machine if value for word in (flag, value)),
        seeds=own.seeds,
        trials=own.trials,
        jobs=own.jobs,
        folder=ROOT,
        storage=own.storage,
    )
    cfgs = check_settings(sweep)
    objective = choose_objective(task, cfgs, own.objective, own.minimize)
    if objective.past_goal is None:
        report_moved_goal(task, cfgs[0])
    return dataclasses.replace(
        sweep,
        axes=tuple(_with_type(axis, cfgs[0]) for axis in axes),
        folder=Path(own.folder or ROOT / _name(sweep)),
        objective=objective,
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


def check_settings(sweep: Sweep) -> list[TrainConfig]:
    """Return the config of every combination of values, parsed as `train` would.

    Of ranges, the ends are checked.
    """
    cfgs = []
    for setting in sweep.combinations:
        flags = [*train_flags(sweep, setting), *sweep.machine_flags]
        try:
            cfg = train_config(sweep, setting)
            check_typed_flags(cfg, flags)
            check_flags(cfg, typed_values(flags))
        except (UserError, ValueError) as error:
            raise BadCallError(f"{error} (In the setting {sweep.describe(setting)}.)") from error
        cfgs.append(cfg)
    return cfgs


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
    return f"{sweep.task}_{keys}"[:MAX_NAME] + f"_{digest(repr(sweep.definition))}"
