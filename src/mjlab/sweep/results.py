"""Comparison of the settings of a sweep: table and plot."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mjlab.rl.evaluation import mean_and_interval, wilson_interval
from mjlab.rl.plot import LABELS, plot_curves
from mjlab.sweep.settings import train_config
from mjlab.sweep.study import Study, TrainedRun, setting_of, trained_run
from mjlab.utils.logging import beside_results
from mjlab.utils.os import write_atomically
from mjlab.utils.string import command_line, counted
from mjlab.utils.tables import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from optuna.trial import FrozenTrial

    from mjlab.sweep.settings import Setting, Sweep

# Number of settings with a color and a legend entry.
_COLORS = 10


@dataclass(frozen=True)
class _Row:
    """Setting with its runs."""

    setting: Setting
    values: list[float]
    """Objectives of the finished seeds; of another machine, their mean."""
    runs: list[TrainedRun]
    """Finished seeds on this machine."""
    state: str
    """Such as `finished`."""
    interval: tuple[float, float] | None
    """95 % confidence interval of the mean over seeds. None: fewer than two seeds."""

    @cached_property
    def mean(self) -> float:
        return statistics.fmean(self.values) if self.values else math.nan

    @property
    def is_scored(self) -> bool:
        """True if the mean is finite."""
        return math.isfinite(self.mean)

    def is_apart_from(self, other: _Row) -> bool:
        """Return True if the intervals do not overlap."""
        if self.interval is None or other.interval is None:
            return False
        return self.interval[0] > other.interval[1] or self.interval[1] < other.interval[0]


class Comparison:
    """Table and plot of the settings, best first."""

    def __init__(self, sweep: Sweep, study: Study) -> None:
        """Read the finished runs of this machine, and the values of others.

        Raises:
            UserError: a run did not log the objective.
        """
        self._sweep = sweep
        rows: dict[tuple[str, ...], _Row] = {}
        for trial in study.trials:
            setting, state = setting_of(trial), trial.state.name
            if state == "WAITING":
                rows.setdefault(tuple(setting.values()), _Row(setting, [], [], "waiting", None))
            elif state != "PRUNED":
                # A retry comes after the failed trial of the same setting.
                rows[tuple(setting.values())] = self._row(setting, trial, study.is_own(trial))
        self._rows = [*rows.values()]
        if sweep.objective.is_ranked:
            sign = 1.0 if sweep.objective.minimize else -1.0
            self._rows.sort(key=lambda r: (not r.is_scored, sign * r.mean if r.is_scored else 0.0))

    def _row(self, setting: Setting, trial: FrozenTrial, is_own: bool) -> _Row:
        if not is_own:
            values = [] if trial.value is None else [trial.value]
            return _Row(setting, values, [], f"elsewhere{'' if values else ', running'}", None)
        seeds = range(1, self._sweep.seeds + 1)
        found = (trained_run(self._sweep, setting, seed) for seed in seeds)
        runs = [run for run in found if run is not None]
        state = "finished" if len(runs) == len(seeds) else "interrupted"
        if trial.state.name == "FAIL":
            state = "failed"
        values = [run.value for run in runs]
        return _Row(setting, values, runs, state, self._interval(setting, values))

    def _interval(self, setting: Setting, values: list[float]) -> tuple[float, float] | None:
        """Return the 95 % confidence interval of the mean of seeds (Student's t).

        For rates, the interval contains that of the episodes (Wilson): seeds that all reach 1 may
        differ in more episodes.
        """
        interval = mean_and_interval(torch.tensor(values)).interval if values else None
        objective = self._sweep.objective
        if interval is None or not objective.is_rate:
            return interval
        episodes = train_config(self._sweep, setting).agent.evaluation.num_episodes * len(values)
        low, high = wilson_interval(statistics.fmean(values), episodes)
        return max(0.0, min(interval[0], low)), min(1.0, max(interval[1], high))

    def table(self) -> Table:
        """Return the table: one row per setting, the best first."""
        sweep = self._sweep
        columns = [*(sweep.short(axis.name) for axis in sweep.axes), sweep.objective.label]
        has_intervals = any(row.interval for row in self._rows)
        columns += ["low", "high"] if has_intervals else []
        others = [*sweep.objective.others]
        columns += [*others, "seeds", "iterations", "minutes", "evaluating", "state"]
        rows: list[list[Any]] = []
        for row in self._rows:
            cells: list[Any] = [*row.setting.values(), row.mean if row.values else None]
            cells += (row.interval or (None, None)) if has_intervals else ()
            cells += [
                _mean([run.last(f"Evaluation/{name}") for run in row.runs]) for name in others
            ]
            cells.append(len(row.runs) or None)
            cells.append(_mean([run.run.info.get("iterations") for run in row.runs]))
            cells.append(_mean([run.training_seconds / 60.0 for run in row.runs]))
            evaluating = sum(run.evaluation_seconds for run in row.runs)
            total = evaluating + sum(run.training_seconds for run in row.runs)
            cells.append(f"{evaluating / total:.0%}" if evaluating else None)
            rows.append([*cells, row.state])
        return Table("settings", tuple(columns), rows)

    def verdict(self) -> str:
        """Return the verdict on the first setting: best, or not distinguishable from others."""
        objective = self._sweep.objective
        if not objective.is_ranked:
            return f"Settings: {objective.reason}"
        first, *others = [row for row in self._rows if row.is_scored]
        name = self._sweep.describe(first.setting)
        value = f"{objective.label} {first.mean:.4g}"
        close = [row for row in others if not first.is_apart_from(row)]
        if others and not close:
            return f"Best: {name}, {value}"
        text = f"{'Lowest' if objective.minimize else 'Highest'}: {name}, {value}"
        if close:
            named = "; ".join(self._sweep.describe(row.setting) for row in close[:3])
            named += f" and {len(close) - 3} others" if len(close) > 3 else ""
            text += f", not distinguishable from {named} with {counted(self._sweep.seeds, 'seed')}"
        return text

    def plot(self) -> Path | None:
        """Plot the objective of each setting, mean and standard deviation over seeds; None without runs."""
        sweep = self._sweep
        curves = [
            (sweep.describe(row.setting), [run.curve for run in row.runs])
            for row in self._rows
            if row.runs
        ]
        if not curves:
            return None
        others = [curve for _, group in curves[_COLORS:] for curve in group]

        def draw(axes: Axes) -> None:
            for position, curve in enumerate(others):
                label = f"{len(curves) - _COLORS} others" if position == 0 else None
                axes.plot(*curve, color="lightgray", lw=0.8, zorder=0.5, label=label)

        tag = sweep.objective.tag
        seeds = f", mean over {sweep.seeds} seeds" if sweep.seeds > 1 else ""
        return plot_curves(
            dict(curves[:_COLORS]),
            sweep.folder / "curves.png",
            title=f"{sweep.task}{seeds}",
            ylabel=LABELS.get(tag, tag),
            draw=draw,
        )

    def report(self) -> None:
        """Write `table.csv`, `table.md` and `curves.png`; print the table and the next commands."""
        sweep, table = self._sweep, self.table()
        if not any(row.is_scored for row in self._rows):
            return
        lines = io.StringIO()
        csv.writer(lines, lineterminator="\n").writerows([table.columns, *table.rows])
        with beside_results("table.csv"):
            write_atomically(sweep.folder / "table.csv", lines.getvalue().encode())
        with beside_results("table.md"):
            write_atomically(sweep.folder / "table.md", f"{table.markdown()}\n".encode())
        with beside_results("curves.png"):
            self.plot()
        print(f"\n{table.text()}\n")
        if "low" in table.columns:
            print("low, high: 95 % confidence interval of the mean over seeds")
        if sweep.objective.is_ranked and sweep.objective.reason:
            print(f"Settings: {sweep.objective.reason}")
        files = [n for n in ("table.csv", "table.md", "curves.png") if (sweep.folder / n).is_file()]
        print(f"{self.verdict()}\nSaved in {sweep.folder}:\n    {', '.join(files)}")
        if not sweep.objective.is_ranked:
            return
        first = self._rows[0]
        print(f"Next, with {sweep.describe(first.setting)}:")
        swept = [f"--{name}={value}" for name, value in first.setting.items()]
        # --gpu-ids would train one run on several GPUs.
        device = sweep.machine_flags if "--device" in sweep.machine_flags else ()
        commands = [["train", sweep.task, *sweep.flags, *swept, *device]]
        if first.runs:
            sign = 1.0 if sweep.objective.minimize else -1.0
            run = min(first.runs, key=lambda run: sign * run.value)
            checkpoint = str(run.run.newest)
            commands.append(["play", sweep.task, "--checkpoint-file", checkpoint])
        for words in commands:
            print(f"    {command_line(['uv', 'run', 'mjlab', *words])}")


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the known values, None without any."""
    known = [float(value) for value in values if value is not None]
    return statistics.fmean(known) if known else None
