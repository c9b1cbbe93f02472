"""Evaluate a tracking policy: `python -m mjlab.tasks.tracking.scripts.evaluate TASK [flags]`.

Equivalent to `evaluate TASK`, with the flags and metrics of mjlab 1.6.
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjlab.cli.main import Command, run_command, run_subcommand
from mjlab.cli.policy_flags import parse_policy_flags
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate
from mjlab.tasks.tracking.mdp.metrics import TRACKING_ERRORS

_NAME = "python -m mjlab.tasks.tracking.scripts.evaluate"
_COMMAND = Command(
    _NAME,
    "watch",
    "evaluate a motion tracking policy",
    argument="TASK",
    details="""\
Play one motion per environment, and print the fraction of episodes without termination, and the
mean errors.""",
    examples=(
        f"{_NAME} Mjlab-Tracking-Flat-Unitree-G1 --wandb-run-path org/project/run",
        f"{_NAME} Mjlab-Tracking-Flat-Unitree-G1 --num-envs 200 --output-file metrics.json",
    ),
    module="mjlab.tasks.tracking.scripts.evaluate",
)


@dataclass
class EvaluateTrackingConfig(EvaluateConfig):
    """Flags of `evaluate` for tracking tasks."""

    num_envs: int | None = 1024
    """Number of environments: episodes at once. Each plays one episode unless --num-episodes is set."""
    output_file: str | None = None
    """JSON file for the metrics. None: do not write."""


def run_evaluate_tracking(task: str, cfg: EvaluateTrackingConfig) -> dict[str, float]:
    """Evaluate a policy of `task`, print the metrics, and return the means of mjlab 1.6.

    The file contains these means and their 95 % intervals as `<name>_interval`. Intervals of errors
    are None for a single episode.

    Raises:
        ValueError: not a tracking task.
    """
    if "Tracking" not in task:
        raise ValueError(
            f"TASK: expected a motion tracking task, got {task!r}; use `uv run mjlab evaluate "
            f"{task}`."
        )
    cfg = copy.copy(cfg)
    if cfg.num_envs is not None and cfg.num_episodes == EvaluateConfig.num_episodes:
        cfg.num_episodes = cfg.num_envs
    metrics = run_evaluate(task, cfg)
    means: dict[str, float] = {"success_rate": metrics["success_rate"]}
    intervals: dict[str, Any] = {"success_rate_interval": list(metrics["success_interval"])}
    for name in TRACKING_ERRORS:
        metric = metrics["metrics"][name]
        means[name] = metric["mean"]
        interval = metric["interval"]
        intervals[f"{name}_interval"] = None if interval is None else list(interval)
    if not cfg.json:
        print("\n".join(f"{name:<16} {value:.4f}" for name, value in means.items()))
    if cfg.output_file is not None:
        path = Path(cfg.output_file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**means, **intervals}, indent=2) + "\n", encoding="utf-8")
    return means


def command(argv: list[str], prog: str) -> None:
    """Run the command."""
    task, *flags = argv
    cfg = parse_policy_flags(EvaluateTrackingConfig, flags, task, prog, purpose="evaluate")
    run_evaluate_tracking(task, cfg)


def main() -> None:
    """Entry point."""
    run_command(lambda argv: run_subcommand(_COMMAND, argv, _NAME))


if __name__ == "__main__":
    main()
