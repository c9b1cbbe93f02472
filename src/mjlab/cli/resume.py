"""Resume: selection of the run, and its settings, number of environments and seed."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path
from typing import TYPE_CHECKING

from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.learners import learner_of
from mjlab.runs import Checkpoint, Run, resolve_checkpoint, runs_in
from mjlab.runs.policy import has_foreign_runner
from mjlab.runs.settings import Settings, apply_settings
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import get_wandb_checkpoint_path, matching_names, newest_match
from mjlab.utils.random import draw_seed

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig
    from mjlab.rl import MjlabOnPolicyRunner


def checkpoint_to_resume(task: str, cfg: TrainConfig) -> Checkpoint | None:
    """Return the checkpoint to resume, or None for a new run.

    The checkpoint is the one with the highest number that matches the pattern, in the last started run
    of `task` and the learner of `cfg` that matches the pattern. Runs without a recorded task match any
    task; runs without a recorded learner match any learner.

    Raises:
        UserError: the matching runs are of other tasks or learners; or the run to resume is still
            running, and resume is `auto`; or a pattern is not a regular expression.
        ValueError: run or checkpoint not found, and resume is not `auto`; the message lists the
            available runs.
    """
    if not cfg.agent.resume:
        return None
    agent, experiment = cfg.agent, cfg.experiment_folder
    if cfg.wandb_run_path is not None:
        run_path = Path(cfg.wandb_run_path)
        return Checkpoint(
            get_wandb_checkpoint_path(experiment, run_path, cfg.wandb_checkpoint_name)[0]
        )
    for flag, pattern in (("run", agent.load_run), ("checkpoint", agent.load_checkpoint)):
        try:
            re.compile(pattern)
        except re.error as error:
            raise UserError(
                f"--agent.load-{flag}: expected a regular expression, got {pattern!r}: {error}."
            ) from error
    for run in _runs_to_resume(task, cfg):
        # Also before its first checkpoint.
        if agent.resume == "auto" and run.state == "running":
            raise UserError(
                f"{run.folder} is still running; stop it, or name this run by --agent.run-name."
            )
        if (path := newest_match(run.folder, agent.load_checkpoint)) is not None:
            return Checkpoint(path)
    if agent.resume == "auto":
        return None
    available = [run.folder.name for run in runs_in(experiment, task, cfg.learner)]
    raise ValueError(
        f"--agent.resume: expected a run matching {agent.load_run!r} with a checkpoint matching "
        f"{agent.load_checkpoint!r} in {str(experiment)!r}, got the runs {available}; train the task first."
    )


def _runs_to_resume(task: str, cfg: TrainConfig) -> list[Run]:
    """Return the runs that match the pattern, the task and the learner, newest first.

    Raises:
        UserError: all runs that match the pattern are of other tasks or learners.
    """
    experiment, pattern, learner = cfg.experiment_folder, cfg.agent.load_run, cfg.learner
    # Jobs that run side by side are told apart by their names.
    run_name = cfg.agent.run_name if cfg.agent.resume == "auto" else ""
    runs = runs_in(experiment, run_name=run_name or None)
    names = matching_names([run.folder.name for run in runs], pattern)
    matching = [run for run in runs if run.folder.name in names]
    others = [run for run in matching if not run.is_of(task, learner)]
    if others and len(others) == len(matching) and cfg.agent.resume != "auto":
        listed = [
            f"{run.folder.name} is of "
            + (
                f"the learner {run.learner!r}"
                if run.is_of(task, None)
                else str(run.info.get("task"))
            )
            for run in others
        ]
        listed[3:] = [f"and {len(listed) - 3} more"] if len(listed) > 3 else []
        by = "" if learner is None else f" by the learner {learner!r}"
        raise UserError(
            f"No run of {task}{by} in {experiment} matches --agent.load-run {pattern!r}: "
            f"{', '.join(listed)}; resume a run with its task and learner."
        )
    return [run for run in matching if run not in others]


def run_to_continue(task: str, cfg: TrainConfig) -> Run | None:
    """Return the run whose settings are the defaults of `cfg`: the resumed one, or that of `--like`.

    Errors in the selection of the resumed run are reported when training starts, after other errors
    in the flags.

    Raises:
        UserError: the run of `--like` was not found, or a run is to be resumed as well.
    """
    if cfg.like is not None:
        if cfg.agent.resume:
            raise UserError("--like: expected a new run, got --agent.resume; use one of them.")
        return Run(resolve_checkpoint(Path(cfg.like), task).path.parent, task)
    # Runs of Weights & Biases are downloaded once, when training starts.
    if cfg.wandb_run_path is not None:
        return None
    try:
        checkpoint = checkpoint_to_resume(task, cfg)
    except (UserError, ValueError, OSError, CheckpointError):
        return None
    if checkpoint is None:
        return None
    run = Run(checkpoint.path.parent, task)
    if run.learner is None and not has_foreign_runner(task):
        with contextlib.suppress(CheckpointError):
            run = Run(run.folder, task, checkpoint.learner)
    return run.as_registered() if cfg.as_registered else run


def with_settings_of(run: Run, cfg: TrainConfig, typed: Settings) -> None:
    """Apply the settings of `run` that were not `typed` to `cfg`, in place.

    For runs that are unknown when flags are parsed.
    """
    rest = {path: value for path, value in run.settings.items() if path not in typed}
    cfg.env, _ = apply_settings(cfg.env, rest, "env")
    cfg.agent, _ = apply_settings(cfg.agent, rest, "agent")


def resume_flags(run_dir: Path, checkpoint: Path | None = None) -> list[str]:
    """Return the flags of `train` that resume the run in `run_dir`, in its log root and experiment.

    `checkpoint` is a checkpoint of the run. None: newest.
    """
    flags = ["--agent.resume", "True", "--agent.load-run", re.escape(run_dir.name)]
    if checkpoint is not None:
        flags += ["--agent.load-checkpoint", re.escape(checkpoint.name)]
    return flags


def check_learner_resumes(cfg: TrainConfig, checkpoint: Checkpoint) -> None:
    """Raise UserError unless the learner of `cfg` wrote `checkpoint`.

    Raises:
        CheckpointError: the checkpoint cannot be read.
    """
    expected, found = learner_of(cfg.agent), checkpoint.learner
    if expected != found:
        raise UserError(
            f"--learner: expected {found!r}, which wrote {checkpoint}, got {expected!r}; use "
            f"--learner {found}, or select another run with --agent.load-run."
        )


def restore_num_envs(cfg: TrainConfig, checkpoint: Checkpoint) -> None:
    """Set the number of environments to that of the resumed run.

    Fewer environments can ruin a policy of several hours within a few iterations.
    """
    count = Run(checkpoint.path.parent).num_envs
    if count is None:
        # Runs of other tools and runners may have checkpoints of any format.
        with contextlib.suppress(CheckpointError):
            count = checkpoint.num_envs
    if count is None:
        print_notice(
            f"{checkpoint} does not record the number of environments; using {cfg.env.scene.num_envs}, "
            "the default of the task. --num-envs overrides."
        )
        return
    cfg.env.scene.num_envs = count
    print(f"Resuming with --num-envs {count}, as before; --num-envs overrides.")


def choose_seed(run: Run | None) -> int:
    """Return and print the seed of the resumed run, or a random seed."""
    if run is not None and run.seed is not None:
        print(f"Seed:    {run.seed}, as before; --seed overrides")
        return run.seed
    seed = draw_seed()
    print(f"Seed:    {seed}, drawn; --seed {seed} repeats the run")
    return seed


def is_finished(cfg: TrainConfig, runner: MjlabOnPolicyRunner, checkpoint: Checkpoint) -> bool:
    """Return True, and print a message, if nothing is left to train: all iterations and evaluations are
    finished, or, with `--agent.resume auto`, the run was solved.
    """
    done, total = runner.current_learning_iteration, cfg.agent.max_iterations
    is_solved = cfg.agent.resume == "auto" and Run(checkpoint.path.parent).state == "solved"
    if (done < total or runner.owes_evaluation) and not is_solved:
        return False
    if is_solved:
        print(f"Nothing to train: the run of {checkpoint} was solved. --agent.resume True goes on.")
    else:
        print(
            f"Nothing to train: {checkpoint} has finished {done} iterations, and "
            f"--agent.max-iterations is {total}, including these. To continue, use e.g. "
            f"--agent.max-iterations {done + 100}."
        )
    return True
