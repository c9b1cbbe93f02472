"""List the runs of a task: `uv run mjlab runs TASK [flags]`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mjlab.cli.flags import parse_flags
from mjlab.runs import Run, runs_in
from mjlab.tasks.registry import load_rl_cfg
from mjlab.utils.errors import UserError
from mjlab.utils.os import to_plain


@dataclass
class RunsConfig:
    """Flags of `mjlab runs`."""

    log_root: str = "logs/rsl_rl"
    """Root folder of all runs."""
    experiment_name: str | None = None
    """Folder of the runs below the root. None: that of the task."""
    json: bool = False
    """Print JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab runs`.

    Raises:
        UserError: no run found.
    """
    task, *flags = argv
    cfg = parse_flags(RunsConfig, RunsConfig(), flags, f"{prog} {task}")
    experiment = Path(cfg.log_root) / (cfg.experiment_name or load_rl_cfg(task).experiment_name)
    runs = [run for run in runs_in(experiment, task) if run.exists]
    if not runs:
        raise UserError(
            f"No run of {task} found in {experiment.resolve()}; run `uv run mjlab train {task}` "
            "first."
        )
    rows = [row_of(run) for run in runs]
    if cfg.json:
        print(json.dumps(to_plain(rows), indent=2))
        return
    table = Table(box=None, pad_edge=False, header_style="dim")
    for title, side in (("run", "left"), ("state", "left"), ("iterations", "right"), ("return", "right"),
                        ("MB", "right"), ("settings", "left")):  # fmt: skip
        table.add_column(title, justify=side, overflow="fold")
    for row in rows:
        settings = "\n".join(f"{name} {value}" for name, value in row["settings"].items())
        score = row["mean_return"]
        shown = "" if score is None else f"{score:.4g}"
        table.add_row(
            row["run"], row["state"], str(row["iterations"] or ""), shown, f"{row['bytes'] / 1e6:.1f}", settings
        )  # fmt: skip
    Console(markup=False, highlight=False).print(table)


def row_of(run: Run) -> dict[str, Any]:
    """Return the row of a run.

    Settings are those that differ from the registered task, profile and learner included.
    """
    chosen = {
        "profile": run.profile,
        "learner": run.learner,
        "num_envs": run.num_envs,
        "seed": run.seed,
    }
    newest, evaluations = run.newest, run.evaluations
    done = run.info.get("iterations")
    if done is None and newest is not None and newest.number is not None:
        done = newest.number + 1
    return {
        "run": run.folder.name,
        "started": None if run.started is None else run.started.isoformat(),
        "state": run.state,
        "continues": run.info.get("resumed"),
        "iterations": done,
        "mean_return": evaluations[-1].get("mean_return") if evaluations else None,
        "evaluated_at": evaluations[-1]["iteration"] if evaluations else None,
        "bytes": sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file()),
        "settings": {name: value for name, value in chosen.items() if value is not None}
        | run.settings,
    }
