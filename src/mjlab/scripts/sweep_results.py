"""Comparison of the settings of a sweep: table and plot."""

from __future__ import annotations

import csv
import io
import math
import os
import shlex
import statistics
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.rl.plot import LABELS, plot_curves
from mjlab.scripts.reference import trained_seconds
from mjlab.scripts.run_folder import checkpoints_in, read_run_info
from mjlab.scripts.sweep_study import Study, curve_of, setting_of, value_of
from mjlab.utils.os import write_atomically
from mjlab.utils.tables import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from optuna.trial import FrozenTrial

    from mjlab.scripts.sweep_settings import Setting, Sweep

# Number of settings with a color and a legend entry.
_COLORS = 10


@dataclass(frozen=True)
class _Row:
    """Setting with its runs."""

    setting: Setting
    values: list[float]
    """Objectives of the finished seeds; of another machine, their mean."""
    runs: list[Path]
    """Last sessions of the finished seeds, on this machine."""
    state: str
    """Empty if all seeds are finished."""

    @cached_property
    def mean(self) -> float:
        return statistics.fmean(self.values) if self.values else math.nan


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
            if trial.state.name not in ("WAITING", "PRUNED"):
                setting = setting_of(trial)
                # A retry comes after the failed trial of the same setting.
                rows[tuple(setting.values())] = self._row(setting, trial, study.is_own(trial))
        sign = 1.0 if sweep.minimize else -1.0
        self._rows = sorted(
            rows.values(), key=lambda row: (not row.values, sign * row.mean if row.values else 0.0)
        )

    def _row(self, setting: Setting, trial: FrozenTrial, is_own: bool) -> _Row:
        if not is_own:
            values = [] if trial.value is None else [trial.value]
            return _Row(setting, values, [], "elsewhere" if values else "elsewhere, running")
        seeds = range(1, self._sweep.seeds + 1)
        runs = {seed: self._sweep.finished_run(setting, seed) for seed in seeds}
        done = {seed: run for seed, run in runs.items() if run is not None}
        values = [value_of(self._sweep, setting, seed) for seed in done]
        state = "" if len(done) == len(runs) else "unfinished"
        if trial.state.name == "FAIL":
            state = "failed"
        return _Row(setting, [v for v in values if v is not None], [*done.values()], state)

    def table(self) -> Table:
        """Return the table: one row per setting, the best first."""
        sweep = self._sweep
        columns = [*(sweep.short(axis.name) for axis in sweep.axes), sweep.label]
        columns += ["std"] if sweep.seeds > 1 else []
        columns += ["seeds", "iterations", "minutes"]
        has_state = any(row.state for row in self._rows)
        rows: list[list[Any]] = []
        for row in self._rows:
            infos = [read_run_info(run) for run in row.runs]
            cells: list[Any] = [*row.setting.values(), row.mean if row.values else None]
            if sweep.seeds > 1:
                cells.append(statistics.stdev(row.values) if len(row.values) > 1 else None)
            cells.append(len(row.runs) or None)
            cells.append(_mean([float(info.get("iterations", 0)) for info in infos]))
            cells.append(_mean([trained_seconds(run) / 60.0 for run in row.runs]))
            rows.append([*cells, row.state] if has_state else cells)
        return Table("settings", (*columns, *(["state"] if has_state else [])), rows)

    def plot(self) -> Path | None:
        """Plot the objective of each setting, mean and standard deviation over seeds; None without runs."""
        sweep = self._sweep
        curves = [
            (sweep.describe(row.setting), [curve_of(sweep, run) for run in row.runs])
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

        assert sweep.objective is not None
        seeds = f", mean over {sweep.seeds} seeds" if sweep.seeds > 1 else ""
        return plot_curves(
            dict(curves[:_COLORS]),
            sweep.folder / "curves.png",
            title=f"{sweep.task}{seeds}",
            ylabel=LABELS.get(sweep.objective, sweep.objective),
            draw=draw,
        )

    def report(self) -> None:
        """Write `table.csv`, `table.md` and `curves.png`; print the table and the next commands."""
        sweep, table = self._sweep, self.table()
        if not any(row.values for row in self._rows):
            return
        lines = io.StringIO()
        csv.writer(lines, lineterminator="\n").writerows([table.columns, *table.rows])
        write_atomically(sweep.folder / "table.csv", lines.getvalue().encode())
        write_atomically(sweep.folder / "table.md", f"{table.markdown()}\n".encode())
        self.plot()
        print(f"\n{table.text()}\n")
        print(f"Saved in {sweep.folder}:\n    table.csv, table.md, curves.png")
        best = self._rows[0]
        print(f"Next, with the best, {sweep.describe(best.setting)}:")
        swept = [f"--{name}={value}" for name, value in best.setting.items()]
        # --gpu-ids would train one run on several GPUs.
        device = sweep.machine_flags if "--device" in sweep.machine_flags else ()
        commands = [["train", sweep.task, *sweep.flags, *swept, *device]]
        if best.runs:
            sign = 1.0 if sweep.minimize else -1.0
            run = min(zip(best.values, best.runs, strict=True), key=lambda pair: sign * pair[0])[1]
            commands.append(["play", sweep.task, "--checkpoint-file", str(checkpoints_in(run)[-1])])
        join = subprocess.list2cmdline if os.name == "nt" else shlex.join
        for words in commands:
            print(f"    {join(['uv', 'run', *words])}")


def _mean(values: list[float]) -> float | None:
    return statistics.fmean(values) if values else None
