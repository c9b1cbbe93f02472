"""Selection and loading of policies for `play`, `evaluate` and recordings."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from mjlab.cli.flags import (
    is_given,
    parse_for_run,
    prepare_env_cfg,
    typed_values,
    with_task_options,
)
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlDistillationRunnerCfg
from mjlab.rl.learners import Learner
from mjlab.runs import Checkpoint, Run, newest_run, resolve_checkpoint, runs_in
from mjlab.runs.run import INFO_FILE, Purpose, RunCfg, registered_env_cfg
from mjlab.runs.settings import apply_settings, with_changes
from mjlab.runs.source import local_policy
from mjlab.tasks.registry import list_tasks, load_rl_cfg
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_list, print_notice
from mjlab.utils.os import get_wandb_checkpoint_path
from mjlab.utils.ranges import Count, Seed, check_ranges
from mjlab.utils.screen import shown


@dataclass
class PolicyFlags:
    """Flags that select the policy and its environments."""

    agent: Literal["zero", "random", "trained"] = field(
        default="trained", metadata=shown("policy", "trained|zero|random")
    )
    """Policy: `zero` actions, `random` uniform actions in [-1, 1], or a `trained` policy."""
    checkpoint_file: str | None = field(default=None, metadata=shown("policy", "FILE"))
    """Checkpoint of the trained policy, its export (`.onnx`), the folder of its run, a ZIP archive, or
    hf:NAME/REPO. None: last checkpoint of the newest run of the task."""
    wandb_run_path: str | None = field(default=None, metadata=shown("policy", "PATH"))
    """Weights & Biases run of the policy, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of the Weights & Biases run. None: newest."""
    num_envs: Count | None = field(default=None, metadata=shown("run", "N", "env.scene.num_envs"))
    """Number of environments; short for --env.scene.num-envs. None: number of the task."""
    seed: Seed | None = field(default=None, metadata=shown("run", "N"))
    """Seed of the environments. None: that of the task."""
    device: str | None = field(default=None, metadata=shown("run", "cpu|cuda:0"))
    """Torch device. None: a GPU if available."""
    engine: Literal["auto", "native", "warp"] | None = field(
        default=None, metadata=shown("run", "auto|native|warp", "env.sim.engine")
    )
    """Physics engine; short for --env.sim.engine. None: that of the task."""
    log_root: str = field(default="logs/rsl_rl", metadata=shown("policy", "DIR"))
    """Root folder of all runs."""
    profile: str | None = field(default=None, metadata=shown("policy", "NAME"))
    """Task profile, such as `cpu`. None: profile that the policy was trained with."""
    learner: Learner | None = field(default=None, metadata=shown("policy", "ppo|sac|distillation"))
    """Learner of the policy; selects its newest run. None: any."""
    as_registered: bool = False
    """Use the task as registered today, without the settings of the run that trained the policy."""
    env: ManagerBasedRlEnvCfg | None = None
    """Environment. None: config of the task, with the settings of the policy's run."""


F = TypeVar("F", bound=PolicyFlags)


def parse_policy_flags(
    kind: type[F], flags: list[str], task: str, command: str, *, purpose: Purpose
) -> F:
    """Return the defaults of `kind` with the settings of the policy's run, updated by `flags`.

    Args:
        kind: Class of the flags of `command`.
        flags: Command line after the task.
        task: Name of the task.
        command: Name of the command, for messages.
        purpose: Purpose of the environments; see `registered_env_cfg`.

    Raises:
        UnknownProfileError: unknown profile.
        ValueError: a typed number is out of its range.
    """

    def make_default(run: Run | None, **choices: Any) -> F:
        # The learner does not change the flags, so the parser handles it.
        profile = choices.get("profile")
        if run is None:
            env = registered_env_cfg(task, profile, purpose)
            return with_task_options(kind(env=env, profile=profile), task)
        choices = {"profile": run.profile, **choices}
        env = run.cfg(purpose, **choices).env
        return with_task_options(kind(env=env, profile=choices["profile"]), task, run)

    cfg = parse_for_run(
        make_default, lambda cfg: _run_of_policy(task, cfg), flags, f"{command} {task}"
    )
    check_ranges(cfg, typed_values(flags))
    # --wandb-run-path has a use with any agent: a task may read other files from the run.
    for flag in ("--checkpoint-file", "--wandb-checkpoint-name"):
        if cfg.agent != "trained" and is_given(flag, flags):
            print_notice(f"{flag} is ignored with --agent {cfg.agent}.")
    return cfg


# Policy selection.


def task_and_flags(argv: list[str]) -> tuple[str, list[str]]:
    """Return task and flags of the arguments of a command that takes a task or a policy.

    Raises:
        UserError: see `task_and_policy`.
    """
    target, *flags = argv
    if target in list_tasks():
        return target, flags
    task, policy = task_and_policy(target)
    return task, ["--checkpoint-file", str(policy), *flags]


def task_and_policy(source: str) -> tuple[str, Path]:
    """Return the task of a policy, and its file or folder on this machine.

    Args:
        source: Folder of a run, checkpoint, export, ZIP archive or hf:NAME/REPO.

    Raises:
        UserError: the policy or its task was not found.
    """
    path = local_policy(source)
    if not path.exists():
        raise UserError(
            f"Policy {source!r}: expected a run folder, a checkpoint (.pt), an exported policy (.onnx), a "
            "ZIP archive or hf:NAME/REPO; not found."
        )
    run = Run(path if path.is_dir() else path.parent)
    task = run.task
    if task is None and path.suffix == ".pt":
        task = Checkpoint(path).task
    if task is None or task not in list_tasks():
        package = run.info.get("package") or "the package of the task"
        raise UserError(
            f"Policy {source!r} task: expected a registered task in {run.folder / INFO_FILE}, got {task!r}; "
            f"install {package}."
        )
    return task, path


def find_checkpoint(task: str, flags: PolicyFlags) -> Checkpoint | None:
    """Return the checkpoint selected by the flags, by default the last of the newest run of the task.

    None if the agent is not trained.

    Raises:
        UserError: checkpoint not found, or written by a learner other than `flags.learner`.
    """
    checkpoint = _select(task, flags)
    if checkpoint is None and flags.agent == "trained":
        experiment = _experiment(task, flags)
        by, choice = "", ""
        if flags.learner is not None:
            by, choice = f" by the learner {flags.learner!r}", f" --learner {flags.learner}"
        raise UserError(
            f"No checkpoint of {task}{by} found in {experiment}; run `uv run mjlab train {task}{choice}` "
            "first, or use --checkpoint-file or --wandb-run-path."
        )
    if checkpoint is None or flags.learner is None or checkpoint.path.suffix == ".onnx":
        return checkpoint
    if (found := checkpoint.learner) != flags.learner:
        raise UserError(
            f"--learner: expected {found!r}, which wrote {checkpoint}, got {flags.learner!r}; leave it out, "
            "or name another checkpoint."
        )
    return checkpoint


def _select(task: str, flags: PolicyFlags) -> Checkpoint | None:
    if flags.agent != "trained":
        return None
    if flags.checkpoint_file is not None:
        return resolve_checkpoint(Path(flags.checkpoint_file), task)
    if flags.wandb_run_path is not None:
        run, name = Path(flags.wandb_run_path), flags.wandb_checkpoint_name
        return Checkpoint(get_wandb_checkpoint_path(_experiment(task, flags), run, name)[0])
    run = newest_run(runs_in(_experiment(task, flags), task, flags.learner))
    return None if run is None else run.newest


def _experiment(task: str, flags: PolicyFlags) -> Path:
    return Path(flags.log_root).resolve() / load_rl_cfg(task).experiment_name


def _run_of_policy(task: str, flags: PolicyFlags) -> Run | None:
    """Return the run of the policy selected by the flags; None if unknown.

    Errors are reported by `find_checkpoint`.
    """
    # Runs of Weights & Biases are downloaded once, after parsing.
    if flags.wandb_run_path and flags.checkpoint_file is None:
        return None
    try:
        checkpoint = _select(task, flags)
    except UserError:
        return None
    if checkpoint is None:
        return None
    run = Run(checkpoint.path.parent, task)
    return run.as_registered() if flags.as_registered else run


# Configs of a policy.


def env_cfg_of(
    task: str, flags: PolicyFlags, checkpoint: Checkpoint | None, *, purpose: Purpose
) -> ManagerBasedRlEnvCfg:
    """Return the environment config in `flags`, or that of the policy's run for `purpose`.

    The task options have prepared the config for the policy in `checkpoint`.

    Raises:
        UserError: the terms of the run are in another order.
        ValueError: a resource of the task was not found.
    """
    run = None if checkpoint is None or flags.as_registered else Run(checkpoint.path.parent, task)
    is_fetched = checkpoint is not None and flags.checkpoint_file is None
    registered = registered_env_cfg(task, flags.profile, purpose)
    cfg = registered if flags.env is None else copy.deepcopy(flags.env)
    if run is not None and (flags.env is None or (is_fetched and flags.wandb_run_path)):
        cfg = with_changes(apply_settings(registered, run.settings, "env")[0], cfg, registered)
    path = None if checkpoint is None else checkpoint.path
    prepare_env_cfg(task, flags, cfg, path, flags.wandb_run_path if is_fetched else None)
    if flags.num_envs is not None:
        cfg.scene.num_envs = flags.num_envs
    if flags.engine is not None:
        cfg.sim.engine = flags.engine
    if flags.seed is not None:
        cfg.seed = flags.seed
    return cfg


def report_policy(
    task: str,
    checkpoint: Checkpoint | None,
    flags: PolicyFlags,
    env: ManagerBasedRlEnvCfg,
    purpose: Purpose,
) -> list[str]:
    """Print the selected policy, and how its environment `env` differs from the registered one.

    Returns:
        Differences, one line each.

    Raises:
        UserError: observations or actions of the run were in another order.
    """
    if checkpoint is None:
        return []
    run = Run(checkpoint.path.parent, task)
    if flags.checkpoint_file is None:
        print_notice(f"Checkpoint: {checkpoint} ({run.describe()})")
    cfg = RunCfg(env=env, agent=load_rl_cfg(task), left_out={})
    if not flags.as_registered:
        cfg = replace(run.cfg(purpose), env=env)
    notes = run.notes(purpose, cfg, flags.profile)
    print_list(f"Settings of {run.folder.name} and of this command:", notes)
    run.check_terms(env, ("actor", "student"))
    return notes


def prepare_teacher(
    task: str, env: ManagerBasedRlEnvCfg, cfg: RslRlBaseRunnerCfg, resumed: Run | None
) -> None:
    """Resolve checkpoint and network of the teacher in a distillation config, in place.

    The network is that of the teacher's run, which may be of another task with the same terms. A
    `resumed` run keeps its teacher. Other configs are unchanged.

    Raises:
        UserError: checkpoint not found, or not of PPO; the teacher's observation or action terms are
            not those of `env`; or the resumed run has a different teacher.
        CheckpointError: the checkpoint is damaged.
    """
    if not isinstance(cfg, RslRlDistillationRunnerCfg):
        return
    flag, teacher = "--agent.teacher-checkpoint", cfg.teacher_checkpoint
    if resumed is not None:
        recorded = resumed.params["agent"].get("teacher_checkpoint")
        file = Path(recorded or "").resolve()
        if teacher is not None and Path(teacher).resolve() not in (file, file.parent):
            raise UserError(
                f"{flag}: expected {recorded} of the resumed run, got {teacher}; leave it out."
            )
        cfg.teacher_checkpoint = recorded if isinstance(recorded, str) else None
    elif teacher is not None:
        checkpoint = resolve_checkpoint(Path(teacher), task)
        if (learner := checkpoint.learner) != "ppo":
            raise UserError(
                f"{flag}: expected a checkpoint of the learner 'ppo', got {checkpoint} of {learner!r}."
            )
        run = Run(checkpoint.path.parent)
        run = Run(run.folder, run.task or task)
        run.check_teacher(env, cfg.obs_groups.get("teacher", ()))
        cfg.teacher_checkpoint = str(checkpoint)
        of_teacher: Any = run.cfg("train", learner="ppo").agent
        cfg.teacher = of_teacher.actor
