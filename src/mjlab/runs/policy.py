"""Policies of runs and the environments that they act in."""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from typing import Any

import torch

from mjlab import rl
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.rl.checkpoint import CheckpointError
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlDistillationRunnerCfg
from mjlab.rl.learners import acting_cfg
from mjlab.runs.checkpoint import Checkpoint
from mjlab.runs.run import Run
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.utils.errors import UserError
from mjlab.utils.torch import prepare_torch


def make_env(
    task: str,
    cfg: ManagerBasedRlEnvCfg,
    device: str,
    *,
    render_mode: str | None = None,
    agent: RslRlBaseRunnerCfg | None = None,
) -> Any:
    """Return the wrapped environment of `cfg`.

    Actions are clipped to `clip_actions` of the learner config `agent`. None: that of the task.
    """
    prepare_torch(device)
    env = ManagerBasedRlEnv(copy.deepcopy(cfg), device=device, render_mode=render_mode)
    clip_actions = (agent or load_rl_cfg(task)).clip_actions
    return rl.RslRlVecEnvWrapper(env, clip_actions=clip_actions)


def make_policy(
    task: str,
    env: Any,
    agent: str,
    checkpoint: Checkpoint | Path | None,
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
    task: str, env: Any, checkpoint: Checkpoint | Path, device: str, profile: str | None = None
) -> Any:
    """Return the deterministic policy in `checkpoint`, for the wrapped environment `env`.

    Args:
        task: Name of the task.
        env: Wrapped environment.
        checkpoint: Checkpoint, or exported policy (`.onnx`).
        device: Torch device of the policy.
        profile: Task profile used for training.

    Raises:
        CheckpointError: the file is missing, damaged, of a different network, or was trained with
            other terms or in another order.
    """
    if not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    if checkpoint.path.suffix == ".onnx":
        from mjlab.rl.exporter_utils import load_onnx_policy

        # The profile may ease the physics of training.
        trained = load_env_cfg(task, profile=profile)
        return load_onnx_policy(checkpoint.path, env, device, trained)
    return load_runner(task, env, checkpoint, device, profile).get_inference_policy(device=device)


def load_runner(
    task: str, env: Any, checkpoint: Checkpoint, device: str, profile: str | None = None
) -> Any:
    """Return a runner with the acting network of `checkpoint`.

    Arguments and errors are those of `load_policy`, without exported policies.
    """
    from mjlab.rl import MjlabOnPolicyRunner

    agent_cfg = agent_cfg_of(task, checkpoint, profile)
    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    try:
        runner = runner_cls(env, acting_cfg(agent_cfg), device=device)
    except (RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint}: building its networks from the settings of its run (run.json and "
            f"params/agent.yaml) failed: {error}"
        ) from error
    network = "student" if isinstance(agent_cfg, RslRlDistillationRunnerCfg) else "actor"
    checkpoint.load_into(runner, {network: True}, device)
    return runner


def export_policy(
    task: str, env: Any, checkpoint: Checkpoint, path: Path, profile: str | None = None
) -> None:
    """Write the policy in `checkpoint` to `path` (`.onnx`), with the metadata of its environment.

    Arguments are those of `load_policy`.

    Raises:
        CheckpointError: see `load_policy`.
        UserError: the export failed.
    """
    if checkpoint.path.suffix == ".onnx":
        from mjlab.rl.exporter_utils import load_onnx_policy

        # Checks that it is a policy of the environment.
        load_onnx_policy(checkpoint.path, env, "cpu", load_env_cfg(task, profile=profile))
        shutil.copyfile(checkpoint.path, path)
        return
    runner = load_runner(task, env, checkpoint, "cpu", profile)
    if runner.export_policy(str(path)) is None:
        raise UserError(f"Policy {checkpoint}: exporting it as ONNX failed, see above.")


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


def agent_cfg_of(
    task: str, checkpoint: Checkpoint | None, profile: str | None = None
) -> RslRlBaseRunnerCfg:
    """Return the learner config of the run that wrote `checkpoint`; that of `task` without one.

    Flags of the run may have changed networks, clipping of actions and the success of an episode.

    Args:
        task: Name of the task.
        checkpoint: Checkpoint, or None.
        profile: Profile of the task.
    """
    if checkpoint is None:
        return load_rl_cfg(task, profile=profile)
    is_readable = checkpoint.path.suffix != ".onnx" and not has_foreign_runner(task)
    choices = {"learner": checkpoint.learner} if is_readable else {}
    return Run(checkpoint.path.parent, task).cfg("train", profile=profile, **choices).agent
