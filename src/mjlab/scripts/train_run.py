"""A training run: from the parsed flags to the files it leaves behind."""

from __future__ import annotations

import contextlib
import logging
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg
from mjlab.rl.progress import TrainingObserver
from mjlab.scripts.cli import UserError, resolve_device
from mjlab.scripts.resume import (
    checkpoint_to_resume,
    is_finished,
    keep_number_of_environments,
)
from mjlab.scripts.run_folder import NewRunFolder, write_run_info
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls

if TYPE_CHECKING:
    from mjlab.rl import MjlabOnPolicyRunner

logger = logging.getLogger(__name__)

_AGENT_COUNTS = ("num_steps_per_env", "max_iterations", "save_interval")
_ALGORITHM_COUNTS = ("num_learning_epochs", "num_mini_batches")
_SEPARATORS = ("/", "\\")


@dataclass
class TrainConfig:
    """Flags of `train`."""

    env: ManagerBasedRlEnvCfg
    """The task."""
    agent: RslRlBaseRunnerCfg
    """The learner."""
    num_envs: int | None = None
    """Number of environments; short for --env.scene.num-envs."""
    device: str | None = None
    """Torch device: cpu, cuda:0, ... None takes a GPU where there is one."""
    engine: Literal["auto", "native", "warp"] | None = None
    """Physics engine; short for --env.sim.engine."""
    video: bool = False
    """Record clips while training."""
    video_length: int = 200
    """Frames of a clip."""
    video_interval: int = 2000
    """Environment steps from the start of one clip to the next."""
    result_video: bool = False
    """Record a clip of the trained policy at the end."""
    enable_nan_guard: bool = False
    """Dump the states that lead to NaN."""
    log_root: str = "logs/rsl_rl"
    """Folder of all runs."""
    wandb_run_path: str | None = None
    """With --agent.resume True: the Weights & Biases run to resume, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of that run; None takes the newest."""
    gpu_ids: list[int] | Literal["all"] | None = field(default_factory=lambda: [0])
    """Indices of the GPUs to use where --device is not given; None trains on the CPU."""

    @staticmethod
    def from_task(task: str) -> TrainConfig:
        """Return the configuration that a task was registered with."""
        return TrainConfig(env=load_env_cfg(task), agent=load_rl_cfg(task))


def launch_training(task: str, cfg: TrainConfig) -> Path:
    """Train `task` as `cfg` says; return the run's folder.

    Nothing is trained where the run to resume has all its iterations; that run's folder is then
    returned. A run that fails before its first iteration leaves no folder.

    Raises:
        UserError, ValueError, OSError, CheckpointError, EngineUnavailableError: what was asked for
            cannot be done; raised before training starts wherever that can be known.
    """
    _check_numbers(cfg)
    _check_names(cfg)
    device = _device(cfg)
    _apply_short_forms(cfg)
    checkpoint = checkpoint_to_resume(task, cfg)
    if checkpoint is not None:
        keep_number_of_environments(task, cfg, checkpoint)
    experiment = Path(cfg.log_root).resolve() / cfg.agent.experiment_name
    with NewRunFolder(experiment, cfg.agent.run_name) as folder:
        env = _build_env(cfg, device, folder.path)
        try:
            print(f"Task:    {task}, {env.num_envs} environments")
            print(f"Physics: {env.unwrapped.sim.capabilities.description}", flush=True)
            runner = _build_runner(task, cfg, env, folder.path, device)
            if checkpoint is not None:
                runner.load(str(checkpoint))
                if is_finished(cfg, runner, checkpoint):
                    return checkpoint.parent
                print(f"Resumed: {checkpoint}, iteration {runner.current_learning_iteration}")
            print(f"Run:     {folder.path}", flush=True)
            _write_params(task, cfg, folder.path)
            _learn(task, cfg, runner, folder)
        finally:
            env.close()
    _leave_results(task, cfg, folder.path, device)
    return folder.path


run_train = launch_training


def _check_numbers(cfg: TrainConfig) -> None:
    """Refuse counts that could only fail once training runs; the environment checks its own."""
    agent: Any = cfg.agent
    counts = {f"--agent.{name}": getattr(agent, name) for name in _AGENT_COUNTS}
    for name in _ALGORITHM_COUNTS:
        # Algorithms other than PPO may lack them.
        counts[f"--agent.algorithm.{name}"] = getattr(getattr(agent, "algorithm", None), name, 1)
    counts |= {"--video-length": cfg.video_length, "--video-interval": cfg.video_interval}
    for flag, value in counts.items():
        if value < 1:
            raise UserError(f"{flag.replace('_', '-')} is {value}; it has to be at least 1.")


def _check_names(cfg: TrainConfig) -> None:
    """Refuse names that would put the run's folder elsewhere than below that of all runs."""
    run_name, experiment = cfg.agent.run_name, cfg.agent.experiment_name
    if any(separator in run_name for separator in _SEPARATORS):
        raise UserError(
            f"--agent.run-name is {run_name!r}; it is part of one folder's name and may not hold "
            "a path separator. Runs are grouped by --agent.experiment-name."
        )
    if Path(experiment).is_absolute() or ".." in experiment.replace("\\", "/").split("/"):
        raise UserError(
            f"--agent.experiment-name is {experiment!r}; it names a folder within --log-root, so "
            "it may be neither absolute nor contain '..'. Choose another place with --log-root."
        )


def _device(cfg: TrainConfig) -> str:
    if cfg.device is not None:
        return resolve_device(cfg.device)
    from mjlab.utils.gpu import select_gpus

    selected, count = select_gpus(cfg.gpu_ids)
    if count > 1:
        raise UserError(
            f"--gpu-ids names {count} GPUs; training on several GPUs is not available yet. Name one."
        )
    if selected is None:
        return "cpu"
    # torch numbers the GPUs that are visible, and so does --gpu-ids.
    index = 0 if cfg.gpu_ids in ("all", None) else cfg.gpu_ids[0]
    return resolve_device(f"cuda:{index}")


def _apply_short_forms(cfg: TrainConfig) -> None:
    if cfg.num_envs is not None:
        cfg.env.scene.num_envs = cfg.num_envs
    if cfg.engine is not None:
        cfg.env.sim.engine = cfg.engine
    if cfg.enable_nan_guard:
        cfg.env.sim.nan_guard.enabled = True
    cfg.env.seed = cfg.agent.seed


def _build_env(cfg: TrainConfig, device: str, run_dir: Path) -> Any:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper

    env: Any = ManagerBasedRlEnv(
        cfg.env, device=device, render_mode="rgb_array" if cfg.video else None
    )
    if cfg.video:
        from mjlab.utils.wrappers import VideoRecorder

        env = VideoRecorder(
            env,
            video_folder=run_dir / "videos" / "train",
            step_trigger=lambda step: step % cfg.video_interval == 0,
            video_length=cfg.video_length,
            disable_logger=True,
        )
    return RslRlVecEnvWrapper(env, clip_actions=cfg.agent.clip_actions)


def _write_params(task: str, cfg: TrainConfig, run_dir: Path) -> None:
    from mjlab.utils.os import dump_yaml

    write_run_info(run_dir, task=task, command=sys.argv)
    dump_yaml(run_dir / "params" / "env.yaml", asdict(cfg.env))
    dump_yaml(run_dir / "params" / "agent.yaml", asdict(cfg.agent))


def _build_runner(
    task: str, cfg: TrainConfig, env: Any, run_dir: Path, device: str
) -> MjlabOnPolicyRunner:
    from mjlab.rl import MjlabOnPolicyRunner
    from mjlab.utils.random import seed_rng

    runner_cls: Any = load_runner_cls(task) or MjlabOnPolicyRunner
    if cfg.agent.logger == "wandb":
        from mjlab.utils.wandb import add_wandb_tags

        add_wandb_tags(cfg.agent.wandb_tags)
    # Seeded anew, so that the first networks depend on the seed alone and not on how many random
    # numbers the environment drew while it was built.
    seed_rng(cfg.agent.seed)
    return runner_cls(env, asdict(cfg.agent), str(run_dir), device)


class _Beginning(TrainingObserver):
    """Keeps the run's folder once there is a run."""

    def __init__(self, folder: NewRunFolder) -> None:
        self._folder = folder

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        self._folder.keep()


def _learn(task: str, cfg: TrainConfig, runner: MjlabOnPolicyRunner, folder: NewRunFolder) -> None:
    from mjlab.scripts.display import TrainingDisplay

    runner.observers += [_Beginning(folder), TrainingDisplay(task)]
    try:
        runner.learn(cfg.agent.max_iterations, init_at_random_ep_len=True)
        # A task's own runner may have its own loop, which need not tell that it starts.
        folder.keep()
    finally:
        # On a full disk, what the folder says about its end is not worth hiding the error that
        # says which checkpoint is intact.
        with contextlib.suppress(OSError):
            write_run_info(
                folder.path,
                ended=runner.stop_reason,
                iterations=runner.current_learning_iteration,
            )


def _leave_results(task: str, cfg: TrainConfig, run_dir: Path, device: str) -> None:
    """Draw the learning curve and, if asked to, record the trained policy; list the files."""
    from mjlab.rl.checkpoint import latest_checkpoint
    from mjlab.rl.plot import plot_run

    plot_run(run_dir, run_dir / "learning_curve.png", title=task)
    checkpoint = latest_checkpoint(run_dir)
    if cfg.result_video and checkpoint is not None:
        from mjlab.scripts.record import record_policy
        from mjlab.viewer.errors import RenderingUnavailableError

        try:
            record_policy(
                task, load_env_cfg(task, play=True), checkpoint, run_dir / "videos", device
            )
        except RenderingUnavailableError as error:
            print(f"No video: {error}")
    print("Results:")
    for pattern in ("model_*.pt", "*.onnx", "*.png", "videos/**/*.mp4"):
        files = sorted(run_dir.glob(pattern), key=lambda path: path.stat().st_mtime)
        if files:
            print(f"    {files[-1]}")
