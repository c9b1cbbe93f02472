"""A training run: from the parsed flags to the files it leaves behind."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Generator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg
from mjlab.rl.learners import Learner, learner_of
from mjlab.rl.run_logger import TrainingObserver
from mjlab.scripts.policy import prepare_teacher
from mjlab.scripts.process_output import ProcessOutput, log_file, output_of
from mjlab.scripts.profiles import parse_with_choices, suggest_profile, tell_foreign_learner
from mjlab.scripts.resume import (
    check_learner_resumes,
    checkpoint_to_resume,
    choices_to_resume,
    is_finished,
    keep_number_of_environments,
    seed_to_resume,
)
from mjlab.scripts.run_folder import (
    NewRunFolder,
    SharedRunFolder,
    exit_by_signal,
    write_resumed,
    write_run_info,
)
from mjlab.scripts.task_options import options_of, prepare_env_cfg, with_task_options
from mjlab.scripts.train_checks import check_flags
from mjlab.scripts.training_device import training_device
from mjlab.sim.warning_log import mujoco_warnings
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls, task_source
from mjlab.utils.processes import (
    ProcessRank,
    cores_per_process,
    end_with_launcher,
    process_rank,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import MjlabOnPolicyRunner

logger = logging.getLogger(__name__)


@dataclass
class TrainConfig:
    """Flags of `train`."""

    env: ManagerBasedRlEnvCfg
    """The task."""
    agent: RslRlBaseRunnerCfg
    """The learner."""
    profile: str | None = None
    """Named settings of the task, such as `cpu`, that all other flags start from; `list-envs` shows
    which there are. None: the task's own, or where a run is resumed, that run's."""
    learner: Learner | None = None
    """Learner, which decides what flags there are under --agent.: `ppo`; `sac`, which learns from a
    replay (soft actor-critic); or `distillation`, a student of --agent.teacher-checkpoint. None: that of
    the resumed run, else that of the profile or task."""
    num_envs: int | None = None
    """Number of environments, of each process; short for --env.scene.num-envs."""
    device: str | None = None
    """Torch device: cpu, cuda:0, ... None takes a GPU where there is one; several processes take
    one each."""
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
    torchrunx_log_dir: str | None = None
    """Folder for what processes other than the first print; None is `torchrunx` in the run's
    folder, and an empty name drops it. The variable TORCHRUNX_LOG_DIR wins."""
    wandb_run_path: str | None = None
    """With --agent.resume True: the Weights & Biases run to resume, as entity/project/run."""
    wandb_checkpoint_name: str | None = None
    """Checkpoint of that run; None takes the newest."""
    live: bool = False
    """Serve a page in the browser that shows the policy as it learns."""
    live_port: int = 8080
    """Port of that page; the next free one where it is taken."""
    live_host: str = field(default="127.0.0.1", kw_only=True)
    """Address that it is served on; 0.0.0.0 serves the whole network."""
    gpu_ids: list[int] | Literal["all"] | None = field(default_factory=lambda: [0])
    """Indices of the GPUs to use where --device is not given, or `all`; with several, a process
    for each is started. None trains on the CPU."""

    @staticmethod
    def from_task(
        task: str, profile: str | None = None, learner: Learner | None = None
    ) -> TrainConfig:
        """Return the configuration that a task was registered with, under one of its profiles.

        `learner` takes the place of the one that the task or the profile chooses.
        """
        return TrainConfig(
            env=load_env_cfg(task, profile=profile),
            agent=load_rl_cfg(task, profile=profile, learner=learner),
            profile=profile,
            learner=learner,
        )


def parse_train_flags(task: str, flags: list[str], prog: str) -> TrainConfig:
    """Return the configuration of `task` with what `flags` change; exits on an unknown flag.

    Raises:
        UnknownProfileError: the task has no such profile.
        ValueError: the learner is unknown, or is not for this task.
    """
    return parse_with_choices(
        lambda **choices: with_task_options(TrainConfig.from_task(task, **choices), task),
        lambda cfg, given: choices_to_resume(task, cfg, given),
        flags,
        prog,
    )


def launch_training(task: str, cfg: TrainConfig) -> Path:
    """Train `task` as `cfg` says; return the run's folder.

    Nothing is trained where the run to resume has all its iterations; that run's folder is then
    returned. A run that fails before its first iteration leaves no folder.

    Raises:
        UserError, ValueError, OSError, CheckpointError, EngineUnavailableError: what was asked for
            cannot be done; raised before training starts wherever that can be known.
    """
    from mjlab.rl.distributed import joined_processes, same_fate
    from mjlab.utils.torch import prepare_torch

    end_with_launcher()
    rank = process_rank()
    # Of all processes, the first alone says which device there is. All say for whom they wait.
    with output_of(rank):
        device = training_device(cfg, rank)
    with joined_processes(device), output_of(rank) as output:
        prepare_torch(device)
        with same_fate():
            check_flags(cfg)
        return _train(task, cfg, device, rank, output)


def _train(
    task: str, cfg: TrainConfig, device: str, rank: ProcessRank, output: ProcessOutput | None
) -> Path:
    from mjlab.rl.distributed import from_first, same_fate

    # The checkpoint is looked for before there is a new folder to be found, and by one process.
    checkpoint = from_first(lambda: checkpoint_to_resume(task, cfg))
    if cfg.agent.seed == -1:
        cfg.agent.seed = from_first(lambda: _choose_seed(checkpoint))
    _apply_short_forms(cfg, rank)
    if checkpoint is not None:
        check_learner_resumes(cfg, checkpoint)
        keep_number_of_environments(task, cfg, checkpoint)
    else:
        suggest_profile(task, cfg.profile, device)
        if rank.is_first:
            tell_foreign_learner(task, cfg.profile, learner_of(cfg.agent))
    with same_fate():
        prepare_teacher(task, cfg.agent, checkpoint)
    with _run_folder(cfg, rank, output) as folder:
        with same_fate():
            fetched_from = None if checkpoint is None else cfg.wandb_run_path
            prepare_env_cfg(task, cfg, cfg.env, checkpoint, fetched_from)
            env = _build_env(cfg, device, folder.path, rank)
        try:
            under = f", profile {cfg.profile}" if cfg.profile else ""
            learner = learner_of(cfg.agent)
            under += "" if learner == "ppo" else f", learner {learner}"
            each = "" if rank.is_alone else f" in each of {rank.world_size} processes"
            print(f"Task:    {task}, {env.num_envs} environments{each}{under}")
            print(f"Physics: {env.unwrapped.sim.capabilities.description}", flush=True)
            with same_fate():
                runner = _build_runner(task, cfg, env, folder.path, device)
                if checkpoint is not None:
                    runner.load(str(checkpoint))
                elif (teacher := getattr(cfg.agent, "teacher_checkpoint", None)) is not None:
                    runner.load_teacher(teacher)
            if checkpoint is not None:
                if is_finished(cfg, runner, checkpoint):
                    return checkpoint.parent
                print(f"Resumed: {checkpoint}, iteration {runner.current_learning_iteration}")
            print(f"Run:     {folder.path}", flush=True)
            if rank.is_first:
                _write_params(task, cfg, folder.path, checkpoint)
            try:
                _learn(task, cfg, runner, folder)
            finally:
                if rank.is_first:
                    _tell_of_divergence(env.unwrapped)
        finally:
            env.close()
    if rank.is_first:
        _leave_results(task, cfg, folder.path, device)
    return folder.path


run_train = launch_training


def _choose_seed(checkpoint: Path | None) -> int:
    """Return the seed of the resumed run, or one that is drawn, and say which."""
    from mjlab.utils.random import draw_seed

    seed = seed_to_resume(checkpoint)
    if seed is not None:
        print(f"Seed:    {seed}, as before; --agent.seed gives another")
        return seed
    seed = draw_seed()
    print(f"Seed:    {seed}, drawn; --agent.seed {seed} repeats the run")
    return seed


@contextlib.contextmanager
def _run_folder(
    cfg: TrainConfig, rank: ProcessRank, output: ProcessOutput | None
) -> Generator[NewRunFolder | SharedRunFolder]:
    """Be in the run's folder, which the first process makes for all."""
    from mjlab.rl.distributed import from_first

    experiment = Path(cfg.log_root).resolve() / cfg.agent.experiment_name
    with contextlib.ExitStack() as stack:
        new = NewRunFolder(experiment, cfg.agent.run_name)
        stack.enter_context(exit_by_signal(unless=lambda: new.is_kept))
        path = from_first(lambda: stack.enter_context(new).path)
        if output is not None:
            output.keep_in(log_file(rank, cfg.torchrunx_log_dir, path))
        yield new if rank.is_first else SharedRunFolder(path)


def _apply_short_forms(cfg: TrainConfig, rank: ProcessRank) -> None:
    from mjlab.utils.random import process_seed

    if cfg.num_envs is not None:
        cfg.env.scene.num_envs = cfg.num_envs
    if cfg.engine is not None:
        cfg.env.sim.engine = cfg.engine
    if cfg.enable_nan_guard:
        cfg.env.sim.nan_guard.enabled = True
    cfg.agent.seed = process_seed(cfg.agent.seed, rank.rank)
    cfg.env.seed = cfg.agent.seed


def _build_env(cfg: TrainConfig, device: str, run_dir: Path, rank: ProcessRank) -> Any:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper

    records = cfg.video and rank.is_first
    with _core_for_learner(cfg, device, rank):
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
    return RslRlVecEnvWrapper(env, clip_actions=cfg.agent.clip_actions)


@contextlib.contextmanager
def _core_for_learner(cfg: TrainConfig, device: str, rank: ProcessRank) -> Generator[None]:
    """Let the physics built within the block leave one core to SAC, which learns at the same time.

    The config is unchanged afterwards, so that evaluations, during which nothing is learned, have all
    cores.
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


def _write_params(task: str, cfg: TrainConfig, run_dir: Path, checkpoint: Path | None) -> None:
    from mjlab.utils.os import dump_yaml

    learner = learner_of(cfg.agent)
    write_run_info(run_dir, task=task, profile=cfg.profile, learner=learner, command=sys.argv)
    if checkpoint is not None:
        write_resumed(run_dir, checkpoint)
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
    further = options_of(task, cfg).runner_kwargs()
    runner = runner_cls(env, asdict(cfg.agent), str(run_dir), device, **further)
    if (source := task_source(task)) is not None and hasattr(runner, "add_git_repo_to_log"):
        runner.add_git_repo_to_log(source)
    return runner


class _Beginning(TrainingObserver):
    """Keeps the run's folder once there is a run."""

    def __init__(self, folder: NewRunFolder | SharedRunFolder) -> None:
        self._folder = folder

    def on_start(self, first_iteration: int, total_iterations: int) -> None:
        self._folder.keep()


def _learn(
    task: str,
    cfg: TrainConfig,
    runner: MjlabOnPolicyRunner,
    folder: NewRunFolder | SharedRunFolder,
) -> None:
    from mjlab.scripts.display import TrainingDisplay

    if isinstance(folder, SharedRunFolder):
        runner.learn(cfg.agent.max_iterations, init_at_random_ep_len=True)
        return
    runner.observers += [_Beginning(folder), TrainingDisplay(task)]
    if cfg.live:
        from mjlab.scripts.live import LiveView

        # First, because the display keeps the terminal to itself once it has started.
        runner.observers.insert(0, LiveView(task, cfg, runner))
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


def _tell_of_divergence(env: ManagerBasedRlEnv) -> None:
    episodes = int(env.nan_resets.sum())
    if episodes > 0:
        environments = int((env.nan_resets > 0).sum())
        print(
            f"Diverged: the physics of {environments} of {env.num_envs} environments, in {episodes} "
            "episodes (Simulation/nan_resets)"
        )
    for kind, count in mujoco_warnings().items():
        print(f"MuJoCo warned {count:,} times: {kind}")


def _leave_results(task: str, cfg: TrainConfig, run_dir: Path, device: str) -> None:
    """Draw the learning curve and, if asked to, record the trained policy; list the files."""
    from mjlab.rl.checkpoint import latest_checkpoint
    from mjlab.rl.plot import plot_run

    # A run that is solved as it is resumed has no iteration of its own.
    with contextlib.suppress(ValueError):
        plot_run(run_dir, run_dir / "learning_curve.png", title=task)
    checkpoint = latest_checkpoint(run_dir)
    if cfg.result_video and checkpoint is not None:
        from mjlab.scripts.policy import policy_env_cfg
        from mjlab.scripts.record import VideoCfg, record_policy
        from mjlab.viewer.offscreen_renderer import RenderingUnavailableError

        env_cfg = policy_env_cfg(task, cfg.profile, purpose="play")
        prepare_env_cfg(task, None, env_cfg, checkpoint)
        try:
            record_policy(
                task,
                env_cfg,
                checkpoint,
                run_dir / "videos",
                device,
                VideoCfg(profile=cfg.profile),
            )
        except RenderingUnavailableError as error:
            print(f"No video: {error}")
    print("Results:")
    for pattern in ("model_*.pt", "*.onnx", "*.png", "videos/**/*.mp4"):
        files = sorted(run_dir.glob(pattern), key=lambda path: path.stat().st_mtime)
        if files:
            print(f"    {files[-1]}")
