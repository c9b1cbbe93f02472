"""What is wrong in the flags of `train` and can be told before anything is built."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import UserError
from mjlab.viewer.page_server import check_address

if TYPE_CHECKING:
    from mjlab.scripts.train_run import TrainConfig

_AGENT_COUNTS = ("num_steps_per_env", "max_iterations", "save_interval")
_ALGORITHM_COUNTS = (
    "num_learning_epochs",
    "num_mini_batches",
    "batch_size",
    "num_updates",
    "replay_steps",
    "num_steps_return",
    "policy_delay",
    "noise_hold",
    "gradient_length",
)
_SEPARATORS = ("/", "\\")


def check_flags(cfg: TrainConfig) -> None:
    """Raise UserError for what is wrong in the flags and can be told without building anything."""
    _check_numbers(cfg)
    _check_names(cfg)


def _check_numbers(cfg: TrainConfig) -> None:
    """Refuse counts that could only fail once training runs; the environment checks its own."""
    agent: Any = cfg.agent
    counts = {f"--agent.{name}": getattr(agent, name) for name in _AGENT_COUNTS}
    for name in _ALGORITHM_COUNTS:
        # Each algorithm has some of them.
        counts[f"--agent.algorithm.{name}"] = getattr(getattr(agent, "algorithm", None), name, 1)
    gradient_length = getattr(agent.algorithm, "gradient_length", None)
    steps = agent.num_steps_per_env * getattr(agent.algorithm, "num_learning_epochs", 1)
    if gradient_length is not None and gradient_length > steps:
        raise UserError(
            f"--agent.algorithm.gradient-length: expected at most {steps}, the steps of an iteration "
            f"times its epochs, got {gradient_length}; with it nothing is learned."
        )
    counts |= {"--video-length": cfg.video_length, "--video-interval": cfg.video_interval}
    for flag, value in counts.items():
        if value < 1:
            raise UserError(f"{flag.replace('_', '-')} is {value}; it has to be at least 1.")
    check_address(cfg.live_host, cfg.live_port, "--live-")


def _check_names(cfg: TrainConfig) -> None:
    """Refuse names that would put the run's folder elsewhere than below that of all runs."""
    run_name, experiment = cfg.agent.run_name, cfg.agent.experiment_name
    if any(separator in run_name for separator in _SEPARATORS):
        raise UserError(
            f"--agent.run-name is {run_name!r}; it is part of one folder's name and may not hold "
            "a path separator. Runs are grouped by --agent.experiment-name."
        )
    if Path(experiment).is_absolute() or ".." in experiment.replace("\\", "/").split("/"):
        raise UserError(
            f"--agent.experiment-name is {experiment!r}; it names a folder within --log-root, so "
            "it may be neither absolute nor contain '..'. Choose another place with --log-root."
        )
