"""Construction of environments and runners for commands."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab import rl
from mjlab.cli.flags import options_of
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.rl.learners import learner_of, train_dict
from mjlab.runs.settings import Settings, apply_settings
from mjlab.tasks.registry import load_runner_cls, task_source
from mjlab.utils.config_fields import check_fields_exist
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
    with _reserve_learner_core(cfg, device, rank):
        env: Any = ManagerBasedRlEnv(
            cfg.env, device=device, render_mode="rgb_array" if records else None
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


@contextlib.contextmanager
def _reserve_learner_core(cfg: TrainConfig, device: str, rank: ProcessRank) -> Generator[None]:
    """Reserve one core for SAC, which learns during collection, in physics built within the block.

    The config is restored afterwards: evaluations do not learn, and use all cores.
    """
    sim = cfg.env.sim
    if sim.num_threads != 0 or learner_of(cfg.agent) != "sac":
        yield
        return
    if device == "cpu" and rank.is_alone:
        sim.num_threads = max(1, min(cores_per_process() - 1, cfg.env.scene.num_envs))
    try:
        yield
    finally:
        sim.num_threads = 0


def training_runner(
    task: str, cfg: TrainConfig, env: Any, run_dir: Path, device: str, settings: Settings
) -> rl.MjlabOnPolicyRunner:
    """Return the runner of `task`, with newly initialized networks.

    Evaluations have the `settings` of the run, also where the profile eases the task for training.

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
    train_cfg = train_dict(cfg.agent)
    if (prepare := cfg.agent.evaluation.prepare_env) is not None:

        def prepare_with_settings(env_cfg: ManagerBasedRlEnvCfg) -> None:
            prepare(env_cfg)
            vars(env_cfg).update(vars(apply_settings(env_cfg, settings, "env")[0]))

        train_cfg["evaluation"]["prepare_env"] = prepare_with_settings
    runner = runner_cls(env, train_cfg, str(run_dir), device, **runner_kwargs)
    if isinstance(runner, rl.MjlabOnPolicyRunner):
        runner.task = task
    if (source := task_source(task)) is not None and hasattr(runner, "add_git_repo_to_log"):
        runner.add_git_repo_to_log(source)
    return runner
