"""Finding and loading a trained policy, for `play`, `evaluate` and recordings."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlDistillationRunnerCfg
from mjlab.rl.learners import Learner, acting_cfg
from mjlab.scripts.cli import BadCallError, UserError, is_given, tell
from mjlab.scripts.profiles import parse_with_choices, profile_of_run
from mjlab.scripts.run_folder import (
    named_checkpoint,
    newest_checkpoint,
    read_agent_params,
    read_run_info,
)
from mjlab.scripts.task_options import prepare_env_cfg, with_task_options
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls

# The classes of networks that a run's own settings may name. No others come from a file, because
# rsl_rl would import and call whatever they name.
_CLASSES = (
    "MLPModel",
    "CNNModel",
    "RNNModel",
    "mjlab.rl.sac_models:SacActorModel",
    "mjlab.rl.sac_models:TwinCriticModel",
    "mjlab.rl.spatial_softmax:SpatialSoftmaxCNNModel",
    "mjlab.tasks.tracking.rl.reference_actor:ReferenceActor",
)

# What a run's own settings may change about the task's networks.
_SETTINGS: dict[str, Callable[[Any], bool]] = {
    "class_name": lambda value: value in _CLASSES,
    "hidden_dims": lambda value: isinstance(value, list) and all(_is_count(v) for v in value),
    "activation": lambda value: isinstance(value, str) and value.isidentifier(),
    "obs_normalization": lambda value: isinstance(value, bool),
    "cnn_cfg": lambda value: value is None or (isinstance(value, dict) and _is_encoder(value)),
    "rnn_type": lambda value: value in (None, "lstm", "gru"),
    "rnn_hidden_dim": lambda value: _is_count(value),
    "rnn_num_layers": lambda value: _is_count(value),
}


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


def _is_encoder(value: Any) -> bool:
    """Return whether `value` is made of numbers and single words, as settings of an encoder are."""
    if isinstance(value, dict):
        return all(isinstance(k, str) and _is_encoder(v) for k, v in value.items())
    if isinstance(value, list):
        return all(_is_encoder(item) for item in value)
    return isinstance(value, (bool, int, float)) or (
        isinstance(value, str) and value.isidentifier()
    )


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
    from mjlab.rl.checkpoint import learner_of_checkpoint

    learner = learner_of_checkpoint(checkpoint)
    agent_cfg = _agent_cfg(task, checkpoint, profile, learner)
    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    runner = runner_cls(env, agent_cfg, None, device)
    network = "student" if learner == "distillation" else "actor"
    runner.load(str(checkpoint), load_cfg={network: True}, strict=True, map_location=device)
    return runner.get_inference_policy(device=device)


def _agent_cfg(
    task: str, checkpoint: Path, profile: str | None = None, learner: Learner | None = None
) -> dict[str, Any]:
    """Return the learner's config of `task`, with the networks that the checkpoint's run had.

    The command line may have given them other sizes and classes than the task and its profile do.
    """
    cfg = acting_cfg(load_rl_cfg(task, profile=profile, learner=learner))
    saved = read_agent_params(checkpoint.parent)
    for network in ("actor", "critic", "student", "teacher"):
        if network in cfg:
            cfg[network] |= _saved_settings(saved, network, cfg[network])
    return cfg


def _saved_settings(
    saved: Mapping[str, Any], network: str, known: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a run's own settings say of a network, as far as it is `known` and valid."""
    settings = saved.get(network)
    if not isinstance(settings, dict):
        return {}
    return {
        name: settings[name]
        for name, is_valid in _SETTINGS.items()
        if name in settings and name in known and is_valid(settings[name])
    }


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
        path = named_checkpoint(Path(given), task)
        _check_teacher(task, path, flag)
        cfg.teacher_checkpoint = str(path)
        saved, network = read_agent_params(path.parent), "actor"
    else:
        return
    cfg.teacher = replace(cfg.teacher, **_saved_settings(saved, network, asdict(cfg.teacher)))


def _check_teacher(task: str, path: Path, flag: str) -> None:
    from mjlab.rl.checkpoint import learner_of_checkpoint

    learner = learner_of_checkpoint(path)
    if learner != "ppo":
        raise UserError(
            f"{flag}: expected a checkpoint of the learner 'ppo', got {path}, which {learner!r} wrote."
        )
    trained = read_run_info(path.parent).get("task", task)
    if trained != task:
        raise UserError(f"{flag}: expected a checkpoint of {task}, got {path}, of {trained}.")


def find_checkpoint(task: str, flags: PolicyFlags) -> Path | None:
    """Return the checkpoint that the flags name, or the newest one of the task.

    None where the flags ask for no trained policy.

    Raises:
        UserError: there is none, or another learner than the flags name wrote it.
    """
    if flags.agent != "trained":
        return None
    if flags.checkpoint_file is not None:
        path = named_checkpoint(Path(flags.checkpoint_file), task)
    elif flags.wandb_run_path is not None:
        from mjlab.utils.os import get_wandb_checkpoint_path

        run = Path(flags.wandb_run_path)
        name = flags.wandb_checkpoint_name
        path = get_wandb_checkpoint_path(_experiment(task, flags), run, name)[0]
    else:
        path = _newest_checkpoint(task, flags)
    _check_learner(flags, path)
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
    tell(f"Checkpoint: {path}")
    return path


def _check_learner(flags: PolicyFlags, checkpoint: Path) -> None:
    """Raise UserError if the flags name another learner than the one that wrote `checkpoint`."""
    if flags.learner is None or checkpoint.suffix == ".onnx":
        return
    from mjlab.rl.checkpoint import learner_of_checkpoint

    found = learner_of_checkpoint(checkpoint)
    if found != flags.learner:
        raise UserError(
            f"--learner: expected {found!r}, which wrote {checkpoint}, got {flags.learner!r}; leave "
            "it out, or name another checkpoint."
        )


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
            path = named_checkpoint(Path(flags.checkpoint_file), task)
        except UserError:
            # It is told when the policy is looked for in earnest.
            return None
    return None if path is None else profile_of_run(task, path.parent)


def constant_policy(env: Any, kind: str) -> Any:
    """Return a policy that does not look: `zero` actions, or `random` ones in [-1, 1]."""
    import torch

    shape = (env.num_envs, env.num_actions)
    if kind == "zero":
        zeros = torch.zeros(shape, dtype=torch.float32, device=env.device)
        return lambda observations: zeros
    return lambda observations: (
        2.0 * torch.rand(shape, dtype=torch.float32, device=env.device) - 1.0
    )


def make_env(
    task: str,
    cfg: ManagerBasedRlEnvCfg,
    device: str,
    num_envs: int | None = None,
    engine: Any = None,
    *,
    seed: int | None = None,
    render_mode: str | None = None,
    profile: str | None = None,
) -> Any:
    """Return the wrapped environment of `cfg`; what is None is left as `cfg` has it.

    Actions are clipped as the learner's config of the task says, under `profile`.
    """
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from mjlab.utils.torch import prepare_torch

    prepare_torch(device)
    cfg = copy.deepcopy(cfg)
    cfg.seed = cfg.seed if seed is None else seed
    if num_envs is not None:
        cfg.scene.num_envs = num_envs
    if engine is not None:
        cfg.sim.engine = engine
    env = ManagerBasedRlEnv(cfg, device=device, render_mode=render_mode)
    clip_actions = load_rl_cfg(task, profile=profile).clip_actions
    return RslRlVecEnvWrapper(env, clip_actions=clip_actions)


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
