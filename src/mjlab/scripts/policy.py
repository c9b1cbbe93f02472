"""Selection and loading of policies for `play`, `evaluate` and recordings."""

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
    read_params,
    read_run_info,
    resolve_checkpoint,
)
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.utils.errors import UserError
from mjlab.utils.logging import print_notice
from mjlab.utils.os import get_wandb_checkpoint_path


@dataclass
class PolicyFlags:
    """Flags that select the policy, the device and the engine."""

    agent: Literal["zero", "random", "trained"] = "trained"
    """Policy: `zero` actions, `random` uniform actions in [-1, 1], or a `trained` policy."""
    checkpoint_file: str | None = None
    """Checkpoint of the trained policy, or its export (`.onnx`). None: newest checkpoint of the task."""
    wandb_run_path: str | None = None
    """Weights & Biases run of the policy, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of the Weights & Biases run. None: newest."""
    device: str | None = None
    """Torch device. None: a GPU if available."""
    engine: Literal["auto", "native", "warp"] | None = None
    """Physics engine."""
    log_root: str = "logs/rsl_rl"
    """Root folder of all runs."""
    profile: str | None = None
    """Task profile, such as `cpu`. None: profile that the policy was trained with."""
    learner: Learner | None = None
    """Learner of the policy; selects its newest run. None: any."""
    env: ManagerBasedRlEnvCfg | None = None
    """Environment. None: config of the task."""


F = TypeVar("F", bound=PolicyFlags)
Purpose = Literal["play", "evaluate", "train"]


def parse_policy_flags(
    kind: type[F], flags: list[str], task: str, command: str, *, purpose: Purpose
) -> F:
    """Return the defaults of `kind` under the profile of the selected policy, updated by `flags`.

    Args:
        kind: Class of the flags of `command`.
        flags: Command line after the task.
        task: Name of the task.
        command: Name of the command, for messages.
        purpose: Purpose of the environments; see `policy_env_cfg`.

    Raises:
        UnknownProfileError: unknown profile.
    """

    def make_default(profile: str | None = None, learner: str | None = None) -> F:
        # The learner does not change the flags, so the parser handles it.
        env_cfg = policy_env_cfg(task, profile, purpose=purpose)
        return with_task_options(kind(env=env_cfg, profile=profile), task)

    def recorded(cfg: F, requested: Mapping[str, str | None]) -> dict[str, str | None]:
        profile = None if "profile" in requested else profile_of_policy(task, cfg)
        return {} if profile is None else {"profile": profile}

    cfg = parse_with_choices(make_default, recorded, flags, prog=f"{command} {task}")
    # --wandb-run-path has a use with any agent: a task may read other files from the run.
    for flag in ("--checkpoint-file", "--wandb-checkpoint-name"):
        if cfg.agent != "trained" and is_given(flag, flags):
            print_notice(f"{flag} is ignored with --agent {cfg.agent}.")
    return cfg


# Policy selection.


def find_checkpoint(task: str, flags: PolicyFlags) -> Path | None:
    """Return the checkpoint selected by the flags, by default the newest of the task.

    None if the agent is not trained.

    Raises:
        UserError: checkpoint not found, or written by a learner other than `flags.learner`.
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
            f"No checkpoint of {task}{by} found in {experiment}; run `train {task}{choice}` first, or use "
            "--checkpoint-file or --wandb-run-path."
        )
    print_notice(f"Checkpoint: {path}")
    return path


def _experiment(task: str, flags: PolicyFlags) -> Path:
    return Path(flags.log_root).resolve() / load_rl_cfg(task).experiment_name


def profile_of_policy(task: str, flags: PolicyFlags) -> str | None:
    """Return the training profile of the policy selected by the flags, or None if unknown.

    The profile of a Weights & Biases run is unknown: downloads do not include `run.json`.
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
            # `find_checkpoint` reports the error.
            return None
    return None if path is None else profile_of_run(task, path.parent)


# Environment of a policy.


def env_cfg_of(
    task: str, flags: PolicyFlags, checkpoint: Path | None, *, purpose: Purpose
) -> ManagerBasedRlEnvCfg:
    """Return the environment config in `flags`, or that of the task for `purpose`.

    The task options have prepared the config for the policy in `checkpoint`.

    Raises:
        ValueError: a resource of the task was not found.
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

    The number of environments is that of the task without the profile: a number chosen for learning
    is unrelated to the number to play.

    Args:
        task: Name of the task.
        profile: Profile, or None.
        purpose: `train` for the training config; `evaluate` for the config of evaluations in
            training; `play` for the play config of the task, with simplifications of the profile
            undone as in evaluations.
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


# Policy loading.


def make_policy(
    task: str,
    env: Any,
    agent: str,
    checkpoint: Path | None,
    device: str,
    profile: str | None = None,
) -> Any:
    """Return the policy in `checkpoint`, or the constant policy of `agent` if `checkpoint` is None.

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
        env: Wrapped environment.
        checkpoint: Checkpoint, or exported policy (`.onnx`).
        device: Torch device of the policy.
        profile: Task profile used for training.

    Raises:
        CheckpointError: the file is missing, damaged, or of a different network.
    """
    if checkpoint.suffix == ".onnx":
        from mjlab.rl.exporter_utils import load_onnx_policy

        return load_onnx_policy(checkpoint, env, device)
    from mjlab.rl import MjlabOnPolicyRunner

    learner = None if has_foreign_runner(task) else learner_of_checkpoint(checkpoint)
    agent_cfg = _agent_cfg(task, checkpoint, profile, learner)
    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    try:
        runner = runner_cls(env, agent_cfg, device=device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint}: building its networks from params/agent.yaml failed: {error}"
        ) from error
    network = "student" if learner == "distillation" else "actor"
    runner.load(str(checkpoint), load_cfg={network: True}, strict=True, map_location=device)
    return runner.get_inference_policy(device=device)


def has_foreign_runner(task: str) -> bool:
    """Return True if the runner of `task` is not derived from mjlab's.

    Its checkpoints may have any format.
    """
    from mjlab.rl import MjlabOnPolicyRunner

    runner_cls = load_runner_cls(task)
    return isinstance(runner_cls, type) and not issubclass(runner_cls, MjlabOnPolicyRunner)


def constant_policy(env: Any, kind: str) -> Any:
    """Return a policy that ignores observations: `zero` or `random` actions in [-1, 1]."""
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
    """Return the learner config of `task`, with the network settings of the checkpoint's run.

    Flags of the run may have changed sizes and classes of the networks.
    """
    rl_cfg = load_rl_cfg(task, profile=profile, learner=learner)
    cfg = acting_cfg(rl_cfg)
    saved = read_params(checkpoint.parent, "agent")
    for network in ("actor", "critic", "student", "teacher"):
        if network in cfg:
            cfg[network] |= _saved_settings(saved, network, getattr(rl_cfg, network))
    return cfg


def _saved_settings(saved: Mapping[str, Any], network: str, model: RslRlModelCfg) -> dict[str, Any]:
    """Return the settings of a run's network that match the field types of `model`.

    rsl_rl imports and calls settings like "module:function", and runs may be untrusted: only class
    names of networks in this package and of the task are accepted.
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
        and (_is_import_free(value) or (name == "class_name" and _is_trusted_class(value, model)))
    }


def _has_type(value: Any, declared: Any) -> bool:
    """Return True if `value`, read from YAML, has the type `declared`. YAML stores tuples as lists."""
    origin, arguments = get_origin(declared), get_args(declared)
    if origin is UnionType:
        return any(_has_type(value, option) for option in arguments)
    if origin is tuple:
        return isinstance(value, list) and all(_has_type(item, arguments[0]) for item in value)
    return type(value) is (origin or declared)


def _is_import_free(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_is_import_free(item) for item in (*value, *value.values()))
    if isinstance(value, list):
        return all(_is_import_free(item) for item in value)
    return not isinstance(value, str) or value.isidentifier()


def _is_trusted_class(class_name: str, model: RslRlModelCfg) -> bool:
    """Return True if `class_name` is that of `model`, or of a network in this package."""
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
    """Resolve checkpoint and network of the teacher in a distillation config, in place.

    The network is that of the teacher's run. A `resumed` run keeps its teacher. Other configs are
    unchanged.

    Raises:
        UserError: checkpoint not found, or not a PPO checkpoint of this task; or the resumed run
            has a different teacher.
        CheckpointError: the checkpoint is damaged.
    """
    if not isinstance(cfg, RslRlDistillationRunnerCfg):
        return
    flag, teacher = "--agent.teacher-checkpoint", cfg.teacher_checkpoint
    if resumed is not None:
        saved, network = read_params(resumed.parent, "agent"), "teacher"
        recorded = saved.get("teacher_checkpoint")
        if teacher is not None and teacher != recorded:
            raise UserError(
                f"{flag}: expected {recorded} of the resumed run, got {teacher}; leave it out."
            )
        cfg.teacher_checkpoint = recorded if isinstance(recorded, str) else None
    elif teacher is not None:
        path = resolve_checkpoint(Path(teacher), task)
        if (learner := learner_of_checkpoint(path)) != "ppo":
            raise UserError(
                f"{flag}: expected a checkpoint of the learner 'ppo', got {path} of {learner!r}."
            )
        if (trained := read_run_info(path.parent).get("task", task)) != task:
            raise UserError(f"{flag}: expected a checkpoint of {task}, got {path} of {trained}.")
        cfg.teacher_checkpoint = str(path)
        saved, network = read_params(path.parent, "agent"), "actor"
    else:
        return
    cfg.teacher = replace(cfg.teacher, **_saved_settings(saved, network, cfg.teacher))
