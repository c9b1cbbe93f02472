"""Resume: selection of the run, and its profile, learner, number of environments and seed."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.rl.checkpoint import CheckpointError, learner_of_checkpoint, load_checkpoint
from mjlab.rl.distributed import STORE_VARIABLE
from mjlab.rl.learners import learner_of
from mjlab.scripts.flags import profile_of_run
from mjlab.scripts.run_folder import read_params, read_run_info, run_folders
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import get_checkpoint_path, get_wandb_checkpoint_path
from mjlab.utils.processes import process_rank
from mjlab.utils.random import draw_seed

if TYPE_CHECKING:
    from mjlab.rl import MjlabOnPolicyRunner
    from mjlab.scripts.train_config import TrainConfig


def checkpoint_to_resume(task: str, cfg: TrainConfig) -> Path | None:
    """Return the checkpoint to resume, or None for a new run.

    The checkpoint is the one with the highest number in the most recently changed run of `task` and the
    learner of `cfg` that matches the patterns. Runs without a recorded task match any task; runs
    without a recorded learner match any learner.

    Raises:
        UserError: the matching runs are of other tasks or learners, or a pattern is not a regular
            expression.
        ValueError: run or checkpoint not found; the message lists the available ones.
    """
    if not cfg.agent.resume:
        return None
    agent = cfg.agent
    experiment = cfg.experiment_folder
    if cfg.wandb_run_path is not None:
        run_path = Path(cfg.wandb_run_path)
        return get_wandb_checkpoint_path(experiment, run_path, cfg.wandb_checkpoint_name)[0]
    for flag, pattern in (("run", agent.load_run), ("checkpoint", agent.load_checkpoint)):
        try:
            re.compile(pattern)
        except re.error as error:
            raise UserError(
                f"--agent.load-{flag}: expected a regular expression, got {pattern!r}: {error}."
            ) from error
    runs = _runs_to_resume(task, cfg)
    for run in runs:
        with contextlib.suppress(ValueError):
            return get_checkpoint_path(experiment, re.escape(run.name), agent.load_checkpoint)
    own = "|".join(re.escape(run.name) for run in runs)
    # Raises an error that lists the runs and checkpoints.
    return get_checkpoint_path(experiment, own or agent.load_run, agent.load_checkpoint)


def _runs_to_resume(task: str, cfg: TrainConfig) -> list[Path]:
    """Return the runs that match the pattern, the task and the learner, newest first.

    Raises:
        UserError: all runs that match the pattern are of other tasks or learners.
    """
    experiment, pattern, learner = cfg.experiment_folder, cfg.agent.load_run, cfg.learner
    # Matching rule of `get_checkpoint_path`.
    runs = run_folders(experiment)
    matching = [run for run in runs if re.fullmatch(pattern, run.name)]
    matching = matching or [run for run in runs if re.match(pattern, run.name)]
    others = {run: why for run in matching if (why := _mismatch(run, task, learner))}
    if others and len(others) == len(matching):
        listed = [f"{run.name} is {why}" for run, why in others.items()]
        listed[3:] = [f"and {len(listed) - 3} more"] if len(listed) > 3 else []
        by = "" if learner is None else f" by the learner {learner!r}"
        raise UserError(
            f"No run of {task}{by} in {experiment} matches --agent.load-run {pattern!r}: "
            f"{', '.join(listed)}; resume a run with its task and learner."
        )
    return [run for run in matching if run not in others]


def _mismatch(run_dir: Path, task: str, learner: str | None) -> str | None:
    """Describe why a run is not of `task` and `learner`; None if it is, or if not recorded."""
    info = read_run_info(run_dir)
    if (found := info.get("task", task)) != task:
        return f"of {found}"
    if learner is not None and (found := info.get("learner", learner)) != learner:
        return f"of the learner {found!r}"
    return None


def resume_flags(run_dir: Path, checkpoint: Path | None = None) -> list[str]:
    """Return the flags of `train` that resume the run in `run_dir`, in its log root and experiment.

    `checkpoint` is a checkpoint of the run. None: newest.
    """
    flags = ["--agent.resume", "True", "--agent.load-run", re.escape(run_dir.name)]
    if checkpoint is not None:
        flags += ["--agent.load-checkpoint", re.escape(checkpoint.name)]
    return flags


def choices_to_resume(
    task: str, cfg: TrainConfig, requested: Mapping[str, str | None]
) -> dict[str, str | None]:
    """Return profile and learner of the run to resume, except those in `requested`.

    The profile is omitted if the run had none, and the learner if it is the default of the task. Both
    are unknown for a Weights & Biases run before the download.
    """
    choices: dict[str, str | None] = {}
    if cfg.wandb_run_path is not None:
        return choices
    try:
        checkpoint = checkpoint_to_resume(task, cfg)
        if checkpoint is None:
            return choices
        learner = learner_of_checkpoint(checkpoint)
    except (UserError, ValueError, OSError, CheckpointError):
        # Reported when training starts, after other errors in the flags.
        return choices
    # All processes parse the flags; our launcher has printed the messages before starting the others.
    reports = STORE_VARIABLE not in os.environ and process_rank().is_first
    if (
        "profile" not in requested
        and (profile := profile_of_run(task, checkpoint.parent)) is not None
    ):
        choices["profile"] = profile
        if reports:
            print_notice(f"Resuming with the profile {profile!r}, as before; --profile overrides.")
    default = load_rl_cfg(task, profile=choices.get("profile", cfg.profile))
    if "learner" not in requested and learner != learner_of(default):
        choices["learner"] = learner
        if reports:
            print_notice(f"Resuming with the learner {learner!r}, as before.")
    return choices


def check_learner_resumes(cfg: TrainConfig, checkpoint: Path) -> None:
    """Raise UserError unless the learner of `cfg` wrote `checkpoint`.

    Raises:
        CheckpointError: the checkpoint cannot be read.
    """
    expected, found = learner_of(cfg.agent), learner_of_checkpoint(checkpoint)
    if expected != found:
        raise UserError(
            f"--learner: expected {found!r}, which wrote {checkpoint}, got {expected!r}; use "
            f"--learner {found}, or select another run with --agent.load-run."
        )


def restore_num_envs(task: str, cfg: TrainConfig, checkpoint: Path) -> None:
    """Set the number of environments to that of the resumed run, unless set by flags.

    Fewer environments can ruin a policy of several hours within a few iterations.
    """
    scene = cfg.env.scene
    default = load_env_cfg(task, profile=cfg.profile).scene.num_envs
    if cfg.num_envs is not None or scene.num_envs != default:
        return
    # Runs of other tools and runners lack the training state, but may have saved their config.
    state = None
    with contextlib.suppress(CheckpointError):
        state = load_checkpoint(checkpoint).get("training_state")
    saved: Any = [state, read_params(checkpoint.parent, "env").get("scene")]
    counts = [holder.get("num_envs") for holder in saved if isinstance(holder, dict)]
    count = next((n for n in counts if isinstance(n, int) and n >= 1), None)
    if count is None:
        print_notice(
            f"{checkpoint} does not record the number of environments; using {scene.num_envs}, the "
            "default of the task. --num-envs overrides."
        )
        return
    scene.num_envs = count
    print(f"Resuming with --num-envs {count}, as before; --num-envs overrides.")


def choose_seed(checkpoint: Path | None) -> int:
    """Return and print the seed of the resumed run, or a random seed."""
    if checkpoint is not None:
        seed: Any = read_params(checkpoint.parent, "agent").get("seed")
        if isinstance(seed, int) and seed >= 0:
            print(f"Seed:    {seed}, as before; --agent.seed overrides")
            return seed
    seed = draw_seed()
    print(f"Seed:    {seed}, drawn; --agent.seed {seed} repeats the run")
    return seed


def is_finished(cfg: TrainConfig, runner: MjlabOnPolicyRunner, checkpoint: Path) -> bool:
    """Return True, and print a message, if the loaded run has finished all iterations and evaluations."""
    done, total = runner.current_learning_iteration, cfg.agent.max_iterations
    if done < total or runner.owes_evaluation:
        return False
    print(
        f"Nothing to train: {checkpoint} has finished {done} iterations, and --agent.max-iterations "
        f"is {total}, including these. To continue, use e.g. --agent.max-iterations {done + 100}."
    )
    return True
