"""Which run `--agent.resume True` goes on from, and whether and how it does."""

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
from mjlab.scripts.run_folder import read_agent_params, read_env_params, read_run_info, run_folders
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
    """Return the checkpoint that `cfg` asks to go on from, or None if it asks for a new run.

    It is the one with the highest number in the run of `task`, by the learner that `cfg` names, that
    was changed last, of those that the patterns let through. Runs that do not name their task count
    as runs of any task; those that do not name their learner, as runs of any learner.

    Raises:
        UserError: the run asked for is of another task or learner, or a pattern is no regular
            expression.
        ValueError: there is no such run or checkpoint; the message says what there is.
    """
    if not cfg.agent.resume:
        return None
    agent = cfg.agent
    experiment = Path(cfg.log_root).resolve() / agent.experiment_name
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
    # By the rule of `get_checkpoint_path`, newest first.
    runs = run_folders(experiment)
    matching = [run for run in runs if re.fullmatch(agent.load_run, run.name)]
    matching = matching or [run for run in runs if re.match(agent.load_run, run.name)]
    others = {run.name: why for run in matching if (why := _other_kind(run, task, cfg.learner))}
    if others and len(others) == len(matching):
        raise UserError(_only_others(task, cfg.learner, agent.load_run, experiment, others))
    for run in matching:
        if run.name not in others:
            with contextlib.suppress(ValueError):
                return get_checkpoint_path(experiment, re.escape(run.name), agent.load_checkpoint)
    own = "|".join(re.escape(run.name) for run in matching if run.name not in others)
    # Raises an error that lists the runs and checkpoints.
    return get_checkpoint_path(experiment, own or agent.load_run, agent.load_checkpoint)


def choices_to_resume(
    task: str, cfg: TrainConfig, given: Mapping[str, str | None]
) -> dict[str, str | None]:
    """Return profile and learner of the run that `cfg` asks to go on from, but for those `given`.

    The profile is left out if the run had none, and the learner if the task chooses it anyway. Those
    of a Weights & Biases run are not known before it is fetched.
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
        # It is told when training is to start, after what else may be wrong with the flags.
        return choices
    if "profile" not in given and (profile := profile_of_run(task, checkpoint.parent)) is not None:
        choices["profile"] = profile
        if _speaks_for_the_run():
            print_notice(
                f"Resuming with the profile {profile!r}, as before; --profile gives another."
            )
    usual = load_rl_cfg(task, profile=choices.get("profile", cfg.profile))
    if "learner" not in given and learner != learner_of(usual):
        choices["learner"] = learner
        if _speaks_for_the_run():
            print_notice(f"Resuming with the learner {learner!r}, as before.")
    return choices


def check_learner_resumes(cfg: TrainConfig, checkpoint: Path) -> None:
    """Raise UserError unless the learner of `cfg` wrote `checkpoint`.

    Raises:
        CheckpointError: the checkpoint cannot be read.
    """
    wanted, found = learner_of(cfg.agent), learner_of_checkpoint(checkpoint)
    if wanted != found:
        raise UserError(
            f"--learner: expected {found!r}, which wrote {checkpoint}, got {wanted!r}; use "
            f"--learner {found}, or choose another run by --agent.load-run."
        )


def _speaks_for_the_run() -> bool:
    """Return whether what concerns all processes of a run is for this one to tell.

    All of them read the flags. Our launcher has told it before it started the others.
    """
    return STORE_VARIABLE not in os.environ and process_rank().is_first


def keep_number_of_environments(task: str, cfg: TrainConfig, checkpoint: Path) -> None:
    """Go on with as many environments as the resumed run had, unless the flags give a number.

    With fewer of them, a policy that took hours is spoilt within a few iterations.

    Raises:
        CheckpointError: the checkpoint cannot be read.
    """
    scene = cfg.env.scene
    usual = load_env_cfg(task, profile=cfg.profile).scene.num_envs
    if cfg.num_envs is not None or scene.num_envs != usual:
        return
    count = _saved_num_envs(checkpoint)
    if count is None:
        print_notice(
            f"{checkpoint} does not say how many environments its run had; the task's "
            f"{scene.num_envs} are used. --num-envs gives another number."
        )
        return
    scene.num_envs = count
    print(f"Resuming with {count} environments, as before; --num-envs gives another number.")


def choose_seed(checkpoint: Path | None) -> int:
    """Return the seed of the resumed run, or a new one, and print which."""
    if checkpoint is not None:
        seed: Any = read_agent_params(checkpoint.parent).get("seed")
        if isinstance(seed, int) and seed >= 0:
            print(f"Seed:    {seed}, as before; --agent.seed gives another")
            return seed
    seed = draw_seed()
    print(f"Seed:    {seed}, drawn; --agent.seed {seed} repeats the run")
    return seed


def is_finished(cfg: TrainConfig, runner: MjlabOnPolicyRunner, checkpoint: Path) -> bool:
    """Return whether the loaded run has all its iterations already, and say so if it has."""
    done, total = runner.current_learning_iteration, cfg.agent.max_iterations
    if done < total:
        return False
    print(
        f"Nothing to train: {checkpoint} has finished {done} iterations, and "
        f"--agent.max-iterations, which counts them in, is {total}. Raise it to train on "
        f"(--agent.max-iterations {done + 100}, say)."
    )
    return True


def _saved_num_envs(checkpoint: Path) -> int | None:
    """Return how many environments the run of `checkpoint` had; None if nothing says so."""
    # Runs of other tools keep no such state, but may have written down their config.
    for holder in (
        load_checkpoint(checkpoint).get("training_state"),
        read_env_params(checkpoint.parent).get("scene"),
    ):
        count: Any = holder.get("num_envs") if isinstance(holder, dict) else None
        if isinstance(count, int) and count >= 1:
            return count
    return None


def _other_kind(run_dir: Path, task: str, learner: str | None) -> str | None:
    """Return in words why a run is not of `task` and `learner`; None if it is, or may be."""
    info = read_run_info(run_dir)
    if (found := info.get("task", task)) != task:
        return f"of {found}"
    if learner is not None and (found := info.get("learner", learner)) != learner:
        return f"of the learner {found!r}"
    return None


def _only_others(
    task: str, learner: str | None, pattern: str, experiment: Path, others: dict[str, str]
) -> str:
    runs = [f"{name} is {why}" for name, why in list(others.items())[:3]]
    more = f", and {len(others) - 3} more" if len(others) > 3 else ""
    asked = "" if pattern == ".*" else f" that matches --agent.load-run {pattern!r}"
    asked = f" by the learner {learner!r}{asked}" if learner is not None else asked
    return (
        f"There is no run of {task} in {experiment}{asked}: {', '.join(runs)}{more}. Resume a run "
        "with the task and the learner that it was trained with."
    )
