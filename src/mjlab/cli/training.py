"""Construction of environments and runners for commands."""

from __future__ import annotations

import copy
import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab import rl
from mjlab.cli.flags import options_of
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.rl.learners import learner_of, train_dict
from mjlab.runs.settings import Settings, apply_settings, with_changes
from mjlab.tasks.registry import load_env_cfg, load_runner_cls, task_source
from mjlab.utils.config_fields import check_fields_exist
from mjlab.utils.logging import print_notice
from mjlab.utils.processes import ProcessRank, cores_per_process
from mjlab.utils.random import seed_rng
from mjlab.utils.torch import prepare_torch
from mjlab.utils.wandb import add_wandb_tags

if TYPE_CHECKING:
    from mjlab.cli.train_config import TrainConfig


def training_env(cfg: TrainConfig, device: str, run_dir: Path, rank: ProcessRank) -> Any:
    """Return the wrapped training environment; with `--video`, record clips into `run_dir`."""
    prepare_torch(device)
    records = cfg.video and rank.is_first
    env_cfg, is_sac = copy.copy(cfg.env), learner_of(cfg.agent) == "sac"
    if env_cfg.sim.num_threads == 0 and is_sac and device == "cpu" and rank.is_alone:
        # SAC learns during collection, on one core.
        num_threads = max(1, min(cores_per_process() - 1, env_cfg.scene.num_envs))
        env_cfg.sim = dataclasses.replace(env_cfg.sim, num_threads=num_threads)
    env: Any = ManagerBasedRlEnv(
        env_cfg, device=device, render_mode="rgb_array" if records else None
    )
    if records:
        from mjlab.utils.wrappers import VideoRecorder

        env = VideoRecorder(
            env,
            video_folder=run_dir / "videos" / "train",
            step_trigger=lambda step: step % cfg.video_interval == 0,
            video_length=cfg.video_length,
            disable_logger=True,
        )
    return rl.RslRlVecEnvWrapper(env, clip_actions=cfg.agent.clip_actions)


def evaluation_env_cfg(task: str, cfg: TrainConfig, settings: Settings) -> ManagerBasedRlEnvCfg:
    """Return the environment config of evaluations during training.

    Config of the task and profile for evaluations, with the changes of the training config `cfg.env`
    and the `settings` of the run: a typed value counts even if it is that of the profile. Prints a
    notice if evaluations have another time between actions than training.
    """
    registered = load_env_cfg(task, profile=cfg.profile, evaluate=True)
    changed = with_changes(registered, cfg.env, load_env_cfg(task, profile=cfg.profile))
    cfg_of_evaluations = apply_settings(changed, settings, "env")[0]
    trained, evaluated = (
        one.decimation * one.sim.mujoco.timestep for one in (cfg.env, cfg_of_evaluations)
    )
    if not math.isclose(trained, evaluated):
        # A profile may have changed the one that was not typed.
        print_notice(
            f"The policy acts every {evaluated:.4g} s in evaluations, and every {trained:.4g} s in training; "
            "to match, set both --env.decimation and --env.sim.mujoco.timestep."
        )
    return cfg_of_evaluations


def training_runner(
    task: str,
    cfg: TrainConfig,
    env: Any,
    run_dir: Path,
    device: str,
    evaluated: ManagerBasedRlEnvCfg,
) -> rl.MjlabOnPolicyRunner:
    """Return the runner of `task`, with newly initialized networks.

    `evaluated` is the environment config of evaluations.

    Raises:
        ValueError: the agent config does not fit the environments.
    """
    check_fields_exist(type(cfg.agent).__name__, cfg.agent)
    runner_cls: Any = load_runner_cls(task) or rl.MjlabOnPolicyRunner
    if cfg.agent.logger == "wandb":
        add_wandb_tags(cfg.agent.wandb_tags)
    # Reseed, so that the initial networks depend on the seed alone, not on the random numbers drawn
    # to build the environment.
    seed_rng(cfg.agent.seed)
    runner_kwargs = options_of(task, cfg).runner_kwargs()
    runner = runner_cls(env, train_dict(cfg.agent), str(run_dir), device, **runner_kwargs)
    if isinstance(runner, rl.MjlabOnPolicyRunner):
        runner.task = task
        runner.evaluate_in(evaluated)
    if (source := task_source(task)) is not None and hasattr(runner, "add_git_repo_to_log"):
        runner.add_git_repo_to_log(source)
    return runner
