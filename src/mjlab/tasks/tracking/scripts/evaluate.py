"""Score a policy that tracks motions: `python -m mjlab.tasks.tracking.scripts.evaluate TASK [flags]`.

It is `evaluate TASK` with the flags and the figures of mjlab 1.6.
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjlab.scripts.cli import Command, run_command, run_subcommand
from mjlab.scripts.evaluate import EvaluateConfig, run_evaluate
from mjlab.scripts.policy import parse_policy_flags
from mjlab.tasks.tracking.mdp.metrics import TRACKING_ERRORS
from mjlab.utils.errors import UserError

_NAME = "python -m mjlab.tasks.tracking.scripts.evaluate"
_COMMAND = Command(
    _NAME,
    "Policies",
    "Score a policy that tracks motions.",
    "mjlab.tasks.tracking.scripts.evaluate:command",
    "TASK",
    "Let each environment play a motion once, and print the share of episodes that no termination "
    "ended,\nand the mean errors.",
    (
        f"{_NAME} Mjlab-Tracking-Flat-Unitree-G1 --wandb-run-path org/project/run",
        f"{_NAME} Mjlab-Tracking-Flat-Unitree-G1 --num-envs 200 --output-file figures.json",
    ),
)


@dataclass
class EvaluateTrackingConfig(EvaluateConfig):
    """Flags of the tracking tasks' own `evaluate`."""

    num_envs: int = 1024
    """Environments, each of which plays one episode."""
    output_file: str | None = None
    """Where the figures go, as JSON; None writes none."""


def run_evaluate_tracking(task: str, cfg: EvaluateTrackingConfig) -> dict[str, float]:
    """Score a policy of `task`, print the figures, and return the means of mjlab 1.6.

    The file has these means, and for each its 95 % interval as `<name>_interval`; of one episode,
    errors have none.

    Raises:
        ValueError: the task does not track motions.
        UserError: `num_episodes` is given, which is always `num_envs` here.
    """
    if "Tracking" not in task:
        raise ValueError(f"{task!r} does not track motions; `evaluate {task}` scores its policies.")
    if cfg.num_episodes != EvaluateConfig.num_episodes:
        raise UserError(
            f"--num-episodes is {cfg.num_episodes}, but here each environment plays one episode; "
            f"give --num-envs {cfg.num_episodes} instead."
        )
    cfg = copy.copy(cfg)
    cfg.num_episodes = cfg.num_envs
    figures = run_evaluate(task, cfg)
    means: dict[str, float] = {"success_rate": figures["success_rate"]}
    intervals: dict[str, Any] = {"success_rate_interval": list(figures["success_interval"])}
    for name in TRACKING_ERRORS:
        metric = figures["metrics"][name]
        means[name] = metric["mean"]
        interval = metric["interval"]
        intervals[f"{name}_interval"] = None if interval is None else list(interval)
    if not cfg.json:
        print("\n".join(f"{name:<16} {value:.4f}" for name, value in means.items()))
    if cfg.output_file is not None:
        path = Path(cfg.output_file)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**means, **intervals}, indent=2) + "\n")
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
