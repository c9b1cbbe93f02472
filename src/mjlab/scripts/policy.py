"""Finding and loading a trained policy, for `play`, `evaluate` and recordings."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import torch
from torch import nn

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.checkpoint import CheckpointError, learner_of_checkpoint
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlDistillationRunnerCfg, RslRlModelCfg
from mjlab.rl.learners import Learner, acting_cfg
from mjlab.scripts.flags import (
    is_given,
    parse_with_choices,
    prepare_env_cfg,
    profile_of_run,
    with_task_options,
)
from mjlab.scripts.run_folder import (
    newest_checkpoint,
    read_agent_params,
    read_run_info,
    resolve_checkpoint,
)
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import get_wandb_checkpoint_path


@dataclass
class PolicyFlags:
    """Flags that say whose actions are taken, and on what they are computed."""

    agent: Literal["zero", "random", "trained"] = "trained"
    """Who acts: all-zero actions, uniform ones in [-1, 1], or a trained policy."""
    checkpoint_file: str | None = None
    """Checkpoint of the trained policy, or its export (`.onnx`); None takes the task's newest."""
    wandb_run_path: str | None = None
    """Weights & Biases run to take the policy from, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of that run; None takes the newest."""
    device: str | None = None
    """Torch device; None takes a GPU where there is one."""
    engine: Literal["auto", "native", "warp"] | None = None
    """Physics engine."""
    log_root: str = "logs/rsl_rl"
    """Folder of all runs."""
    profile: str | None = None
    """Named settings of the task, such as `cpu`. None: those that the policy was trained with."""
    learner: Learner | None = None
    """Learner that the policy is of, to take the newest one of it. None: any."""
    env: ManagerBasedRlEnvCfg | None = None
    """The environment; None takes the task's config."""


F = TypeVar("F", bound=PolicyFlags)
Purpose = Literal["play", "evaluate", "train"]


def parse_policy_flags(
    kind: type[F], flags: list[str], task: str, command: str, *, purpose: Purpose
) -> F:
    """Return what `flags` make of the defaults of `kind`, under the profile of the policy they name.

    Args:
        kind: The flags of `command`.
        flags: The command line, after the task.
        task: Name of the task.
        command: The command, for messages.
        purpose: What the environments are for; see `policy_env_cfg`.

    Raises:
        UnknownProfileError: the task has no such profile.
        BadCallError: a checkpoint is named for an agent that has none.
    """

    def make_default(profile: str | None = None, learner: str | None = None) -> F:
        # The learner changes no flags here, so that it is left to the parser.
        env_cfg = policy_env_cfg(task, profile, purpose=purpose)
        return with_task_options(kind(env=env_cfg, profile=profile), task)

    def recorded(cfg: F, given: Mapping[str, str | None]) -> dict[str, str | None]:
        profile = None if "profile" in given else profile_of_policy(task, cfg)
        return {} if profile is None else {"profile": profile}

    cfg = parse_with_choices(make_default, recorded, flags, prog=f"{command} {task}")
    # A task may read more than a policy from a run at Weights & Biases.
    for flag in ("--checkpoint-file", "--wandb-checkpoint-name"):
        if cfg.agent != "trained" and is_given(flag, flags):
            raise BadCallError(
                f"{flag}: expected a trained agent, got --agent {cfg.agent}; leave out one of them."
            )
    return cfg


# Finding the policy.


def find_checkpoint(task: str, flags: PolicyFlags) -> Path | None:
    """Return the checkpoint that the flags name, or the newest one of the task.

    None where the flags ask for no trained policy.

    Raises:
        UserError: there is none, or another learner than the flags name wrote it.
    """
    if flags.agent != "trained":
        return None
    if flags.checkpoint_file is not None:
        path = resolve_checkpoint(Path(flags.checkpoint_file), task)
    elif flags.wandb_run_path is not None:
        run = Path(flags.wandb_run_path)
        name = flags.wandb_checkpoint_name
        path = get_wandb_checkpoint_path(_experiment(task, flags), run, name)[0]
    else:
        path = _newest_checkpoint(task, flags)
    if flags.learner is not None and path.suffix != ".onnx":
        found = learner_of_checkpoint(path)
        if found != flags.learner:
            raise UserError(
                f"--learner: expected {found!r}, which wrote {path}, got {flags.learner!r}; leave it "
                "out, or name another checkpoint."
            )
    return path


def _newest_checkpoint(task: str, flags: PolicyFlags) -> Path:
    experiment = _experiment(task, flags)
    path = newest_checkpoint(experiment, task, flags.learner)
    if path is None:
        by, choice = "", ""
        if flags.learner is not None:
            by, choice = f" by the learner {flags.learner!r}", f" --learner {flags.learner}"
        raise UserError(
            f"No checkpoint was named, and {experiment} has none of {task}{by}. Run `train "
            f"{task}{choice}` first, or give --checkpoint-file or --wandb-run-path."
        )
    print_notice(f"Checkpoint: {path}")
    return path


def _experiment(task: str, flags: PolicyFlags) -> Path:
    return Path(flags.log_root).resolve() / load_rl_cfg(task).experiment_name


def profile_of_policy(task: str, flags: PolicyFlags) -> str | None:
    """Return the profile that the policy which the flags name was trained with, if it is known.

    That of a Weights & Biases run is not: its files come without what the run says about itself.
    """
    if flags.agent != "trained":
        return None
    if flags.checkpoint_file is None:
        if flags.wandb_run_path is not None:
            return None
        path = newest_checkpoint(_experiment(task, flags), task, flags.learner)
    else:
        try:
            path = resolve_checkpoint(Path(flags.checkpoint_file), task)
        except UserError:
            # It is told when the policy is looked for in earnest.
            return None
    return None if path is None else profile_of_run(task, path.parent)


# Its environment.


def env_cfg_of(
    task: str, flags: PolicyFlags, checkpoint: Path | None, *, purpose: Purpose
) -> ManagerBasedRlEnvCfg:
    """Return the environment config in `flags`, or the task's own for this purpose.

    The task has got what it needs for the policy in `checkpoint`.

    Raises:
        ValueError: something that the task needs is not there.
    """
    if flags.env is None:
        cfg = policy_env_cfg(task, flags.profile, purpose=purpose)
    else:
        cfg = copy.deepcopy(flags.env)
    is_fetched = checkpoint is not None and flags.checkpoint_file is None
    prepare_env_cfg(task, flags, cfg, checkpoint, flags.wandb_run_path if is_fetched else None)
    return cfg


def policy_env_cfg(task: str, profile: str | None, *, purpose: Purpose) -> ManagerBasedRlEnvCfg:
    """Return the environment config for a policy trained under `profile`.

    It has as many environments as the task has without the profile: how many of them learning takes
    says nothing about how many to look at.

    Args:
        task: Name of the task.
        profile: The profile, or None.
        purpose: `train` for the config of training; `evaluate` for that of evaluations in training;
            `play` for the task's own to play with, in which what the profile makes easier for
            learning is as hard as it is in evaluations.
    """
    play = purpose == "play"
    cfg = load_env_cfg(task, play=play, profile=profile)
    if profile is not None:
        cfg.scene.num_envs = load_env_cfg(task, play=play).scene.num_envs
    if purpose == "evaluate" or (play and profile is not None):
        prepare = load_rl_cfg(task, profile=profile).evaluation.prepare_env
        if prepare is not None:
            prepare(cfg)
    return cfg


# Loading it.


def make_policy(
    task: str,
    env: Any,
    agent: str,
    checkpoint: Path | None,
    device: str,
    profile: str | None = None,
) -> Any:
    """Return the policy in `checkpoint`, or where there is none the constant one of `agent`.

    Raises:
        CheckpointError: see `load_policy`.
    """
    if checkpoint is None:
        return constant_policy(env, agent)
    return load_policy(task, env, checkpoint, device, profile)


def load_policy(
    task: str, env: Any, checkpoint: Path, device: str, profile: str | None = None
) -> Any:
    """Return the deterministic policy in `checkpoint`, for the wrapped environment `env`.

    Args:
        task: Name of the task.
        env: The wrapped environment.
        checkpoint: A checkpoint, or an exported policy (`.onnx`).
        device: Torch device of the policy.
        profile: Profile of the task that it was trained with.

    Raises:
        CheckpointError: the file is missing, damaged, or holds another network.
    """
    if checkpoint.suffix == ".onnx":
        from mjlab.rl.exporter_utils import load_onnx_policy

        return load_onnx_policy(checkpoint, env, device)
    from mjlab.rl import MjlabOnPolicyRunner

    learner = learner_of_checkpoint(checkpoint)
    agent_cfg = _agent_cfg(task, checkpoint, profile, learner)
    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    try:
        runner = runner_cls(env, agent_cfg, None, device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"The networks of {checkpoint} cannot be built as params/agent.yaml beside it says: {error}"
        ) from error
    network = "student" if learner == "distillation" else "actor"
    runner.load(str(checkpoint), load_cfg={network: True}, strict=True, map_location=device)
    return runner.get_inference_policy(device=device)


def constant_policy(env: Any, kind: str) -> Any:
    """Return a policy that does not look: `zero` actions, or `random` ones in [-1, 1]."""
    shape = (env.num_envs, env.num_actions)
    if kind == "zero":
        zeros = torch.zeros(shape, dtype=torch.float32, device=env.device)
        return lambda observations: zeros
    return lambda observations: (
        2.0 * torch.rand(shape, dtype=torch.float32, device=env.device) - 1.0
    )


def _agent_cfg(
    task: str, checkpoint: Path, profile: str | None = None, learner: Learner | None = None
) -> dict[str, Any]:
    """Return the learner's config of `task`, with the networks that the checkpoint's run had.

    The command line may have given them other sizes and classes than the task and its profile do.
    """
    rl_cfg = load_rl_cfg(task, profile=profile, learner=learner)
    cfg = acting_cfg(rl_cfg)
    saved = read_agent_params(checkpoint.parent)
    for network in ("actor", "critic", "student", "teacher"):
        if network in cfg:
            cfg[network] |= _saved_settings(saved, network, getattr(rl_cfg, network))
    return cfg


def _saved_settings(saved: Mapping[str, Any], network: str, model: RslRlModelCfg) -> dict[str, Any]:
    """Return the settings of a run's network that have the types of the fields of `model`.

    rsl_rl imports and calls what a setting like "module:function" names, and a run may come from
    a stranger: only class names of networks of this package and of the task itself are taken.
    """
    settings = saved.get(network)
    if not isinstance(settings, dict):
        return {}
    types = get_type_hints(type(model))
    return {
        name: value
        for name, value in settings.items()
        if name in types
        and _has_type(value, types[name])
        and (_names_nothing_to_import(value) or (name == "class_name" and _is_own(value, model)))
    }


def _has_type(value: Any, declared: Any) -> bool:
    """Return whether `value`, read from YAML, is of the `declared` type; tuples are lists there."""
    origin, arguments = get_origin(declared), get_args(declared)
    if origin is UnionType:
        return any(_has_type(value, option) for option in arguments)
    if origin is tuple:
        return isinstance(value, list) and all(_has_type(item, arguments[0]) for item in value)
    return type(value) is (origin or declared)


def _names_nothing_to_import(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_names_nothing_to_import(item) for item in (*value, *value.values()))
    if isinstance(value, list):
        return all(_names_nothing_to_import(item) for item in value)
    return not isinstance(value, str) or value.isidentifier()


def _is_own(class_name: str, model: RslRlModelCfg) -> bool:
    """Return whether `class_name` is that of `model`, or of a network of this package."""
    if class_name == model.class_name:
        return True
    module, _, name = class_name.partition(":")
    if not module.startswith("mjlab."):
        return False
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return isinstance(found, type) and issubclass(found, nn.Module)


def prepare_teacher(task: str, cfg: RslRlBaseRunnerCfg, resumed: Path | None) -> None:
    """Settle checkpoint and network of a distillation's teacher, in place; else do nothing.

    The network is that of the teacher's run. A `resumed` run has its teacher already.

    Raises:
        UserError: there is no such checkpoint, or it is not one of PPO and of this task; or the
            resumed run has another teacher.
        CheckpointError: the checkpoint is damaged.
    """
    if not isinstance(cfg, RslRlDistillationRunnerCfg):
        return
    flag, given = "--agent.teacher-checkpoint", cfg.teacher_checkpoint
    if resumed is not None:
        saved, network = read_agent_params(resumed.parent), "teacher"
        recorded = saved.get("teacher_checkpoint")
        if given is not None and given != recorded:
            raise UserError(
                f"{flag}: expected that of the resumed run, {recorded}, got {given}; leave it out."
            )
        cfg.teacher_checkpoint = recorded if isinstance(recorded, str) else None
    elif given is not None:
        path = resolve_checkpoint(Path(given), task)
        if (learner := learner_of_checkpoint(path)) != "ppo":
            raise UserError(
                f"{flag}: expected a checkpoint of the learner 'ppo', got {path}, which {learner!r} "
                "wrote."
            )
        if (trained := read_run_info(path.parent).get("task", task)) != task:
            raise UserError(f"{flag}: expected a checkpoint of {task}, got {path}, of {trained}.")
        cfg.teacher_checkpoint = str(path)
        saved, network = read_agent_params(path.parent), "actor"
    else:
        return
    cfg.teacher = replace(cfg.teacher, **_saved_settings(saved, network, cfg.teacher))
