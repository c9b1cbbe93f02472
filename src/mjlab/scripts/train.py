"""Train a task: `uv run train TASK [flags]`."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import sys
from collections.abc import Generator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mjlab.compat import older_names
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg
from mjlab.rl.learners import Learner, learner_of
from mjlab.rl.run_logger import TrainingObserver
from mjlab.scripts.cli import run_alias
from mjlab.scripts.flags import (
    is_given,
    options_of,
    parse_with_choices,
    prepare_env_cfg,
    resolve_device,
    suggest_profile,
    tell_foreign_learner,
    with_task_options,
)
from mjlab.scripts.policy import prepare_teacher
from mjlab.scripts.process_output import ProcessOutput, log_file, output_of
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
from mjlab.sim.warning_log import mujoco_warnings
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls, task_source
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.gpu import egl_device_id, select_gpus
from mjlab.utils.processes import ProcessRank, cores_per_process, end_with_launcher, process_rank
from mjlab.viewer.page_server import check_address

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import MjlabOnPolicyRunner


_AGENT_COUNTS = ("num_steps_per_env", "max_iterations", "save_interval")
_ALGORITHM_COUNTS = (
    "num_learning_epochs",
    "num_mini_batches",
    "batch_size",
    "num_updates",
    "replay_steps",
    "num_steps_return",
    "policy_delay",
    "noise_hold",
    "gradient_length",
)
_SEPARATORS = ("/", "\\")


def check_flags(cfg: TrainConfig) -> None:
    """Raise UserError for what is wrong in the flags and can be told without building anything."""
    _check_numbers(cfg)
    _check_names(cfg)


def check_typed_flags(cfg: TrainConfig, flags: list[str]) -> None:
    """Raise BadCallError for a flag of the command line `flags` that would be ignored."""
    for flag in ("--wandb-run-path", "--agent.load-run", "--agent.load-checkpoint"):
        if is_given(flag, flags) and not cfg.agent.resume:
            raise BadCallError(
                f"{flag}: expected a run to resume, got a new one; use --agent.resume True with it."
            )
    if is_given("--wandb-checkpoint-name", flags) and cfg.wandb_run_path is None:
        raise BadCallError(
            "--wandb-checkpoint-name: expected a run at Weights & Biases, got none; use "
            "--wandb-run-path with it."
        )
    if is_given("--gpu-ids", flags) and cfg.gpu_ids is not None:
        _check_gpus_are_used(cfg)
    # Networks and algorithms are chosen by their class names, and the runner by the task.
    kinds = {field.name: field.default for field in dataclasses.fields(cfg.agent)}
    name = getattr(cfg.agent, "class_name", None)
    if is_given("--agent.class-name", flags) and name != kinds["class_name"]:
        raise BadCallError(
            f"--agent.class-name: expected {kinds['class_name']!r}, got {name!r}, which nothing reads; "
            "use runner_cls of register_mjlab_task for a runner, or --learner."
        )


def _check_gpus_are_used(cfg: TrainConfig) -> None:
    if cfg.device is not None and (process_rank().is_alone or not cfg.device.startswith("cuda")):
        raise BadCallError(
            f"--gpu-ids: expected no --device beside it, got {cfg.device!r}; leave out one of them."
        )
    if select_gpus(cfg.gpu_ids) == (None, 0):
        raise BadCallError(
            f"--gpu-ids: expected a GPU, got {cfg.gpu_ids} where none is visible; leave it out to "
            "train on the CPU."
        )


def _check_numbers(cfg: TrainConfig) -> None:
    """Refuse counts that could only fail once training runs; the environment checks its own."""
    agent: Any = cfg.agent
    counts = {f"--agent.{name}": getattr(agent, name) for name in _AGENT_COUNTS}
    for name in _ALGORITHM_COUNTS:
        # Each algorithm has some of them.
        counts[f"--agent.algorithm.{name}"] = getattr(getattr(agent, "algorithm", None), name, 1)
    gradient_length = getattr(agent.algorithm, "gradient_length", None)
    steps = agent.num_steps_per_env * getattr(agent.algorithm, "num_learning_epochs", 1)
    if gradient_length is not None and gradient_length > steps:
        raise UserError(
            f"--agent.algorithm.gradient-length: expected at most {steps}, the steps of an iteration "
            f"times its epochs, got {gradient_length}; with it nothing is learned."
        )
    learning_starts = getattr(agent.algorithm, "learning_starts", 0)
    if learning_starts > (total := agent.num_steps_per_env * agent.max_iterations):
        raise UserError(
            f"--agent.algorithm.learning-starts: expected at most {total}, the environment steps of "
            f"the run, got {learning_starts}; with it nothing is learned."
        )
    counts |= {"--video-length": cfg.video_length, "--video-interval": cfg.video_interval}
    for flag, value in counts.items():
        if value < 1:
            raise UserError(f"{flag.replace('_', '-')} is {value}; it has to be at least 1.")
    # An infinite bound, as of gradients, is one that is not there.
    for name, value in vars(agent.algorithm).items():
        if isinstance(value, float) and (
            math.isnan(value) or (name.endswith("learning_rate") and math.isinf(value))
        ):
            flag = f"--agent.algorithm.{name.replace('_', '-')}"
            raise UserError(f"{flag}: expected a finite number, got {value}.")
    if cfg.live:
        check_address(cfg.live_host, cfg.live_port, "--live-")


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


_EGL_VARIABLE = "MUJOCO_EGL_DEVICE_ID"


def gpus_to_share(cfg: TrainConfig) -> list[int | str]:
    """Return the entries of `CUDA_VISIBLE_DEVICES` for a run on several GPUs of this machine.

    Empty where there is no more than one to use, and in a process that a launcher started: which
    GPUs there are was decided there.
    """
    if cfg.device is not None or not process_rank().is_alone:
        return []
    selected, count = select_gpus(cfg.gpu_ids)
    return selected if selected is not None and count > 1 else []


def training_device(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the torch device of this process; rendering goes to the same GPU.

    Raises:
        UserError: there are fewer GPUs than processes, or all were given the same one.
        ValueError: `gpu_ids` names a GPU that is not there.
    """
    device = _only_device(cfg) if rank.is_alone else _device_of(cfg, rank)
    if device.startswith("cuda"):
        # EGL numbers all GPUs of the machine, and torch those that are visible.
        physical = egl_device_id(int(device.partition(":")[2] or 0))
        if physical is not None:
            os.environ.setdefault(_EGL_VARIABLE, str(physical))
    return device


def _only_device(cfg: TrainConfig) -> str:
    if cfg.device is not None:
        return resolve_device(cfg.device)
    selected, count = select_gpus(cfg.gpu_ids)
    if count > 1:
        raise UserError(
            f"--gpu-ids names {count} GPUs, and this is one process. The command `train` starts one "
            "for each GPU, and so does torchrun; a program that calls `launch_training` trains on "
            "one GPU."
        )
    if selected is None:
        return "cpu"
    # torch numbers the GPUs that are visible, and so does --gpu-ids.
    index = 0 if cfg.gpu_ids in ("all", None) else cfg.gpu_ids[0]
    return resolve_device(f"cuda:{index}")


def _device_of(cfg: TrainConfig, rank: ProcessRank) -> str:
    """Return the device of one process among several."""
    if cfg.device is not None and not cfg.device.startswith("cuda"):
        return resolve_device(cfg.device)
    if cfg.device is not None and ":" in cfg.device and rank.local_world_size > 1:
        raise UserError(
            f"--device {cfg.device} is one GPU, and this machine has {rank.local_world_size} "
            "processes of the run. Give --device cuda for one GPU each, or --device cpu."
        )
    # One GPU is the default where there is one process, so it says nothing where there are more.
    named = cfg.gpu_ids if isinstance(cfg.gpu_ids, list) and len(cfg.gpu_ids) > 1 else "all"
    if cfg.device is None:
        selected, count = select_gpus(None if cfg.gpu_ids is None else named)
        if selected is None:
            return "cpu"
    else:
        resolve_device(cfg.device)
        count = select_gpus(named)[1]
    if rank.local_rank >= count:
        raise UserError(
            f"This machine has {rank.local_world_size} processes of the run and {count} GPUs to "
            f"use. Start at most {count} here, or give --device cpu."
        )
    return f"cuda:{rank.local_rank if named == 'all' else named[rank.local_rank]}"


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
        from mjlab.scripts.policy import VideoCfg, policy_env_cfg, record_policy
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


__getattr__ = older_names(__name__)


def command(argv: list[str], prog: str) -> None:
    """Run `train`; with several GPUs, start a process for each."""
    task, *flags = argv
    cfg = parse_train_flags(task, flags, prog=f"{prog} {task}")
    check_typed_flags(cfg, flags)
    gpus = gpus_to_share(cfg)
    if not gpus:
        launch_training(task, cfg)
        return
    from mjlab.scripts.launcher import launch_workers, train_command

    check_flags(cfg)
    # Of the GPUs that they see, the processes use all.
    workers = train_command(task, [*flags, "--gpu-ids", "all"])
    launch_workers(workers, len(gpus), {"CUDA_VISIBLE_DEVICES": ",".join(map(str, gpus))})


def main() -> None:
    """Entry point of `train`."""
    run_alias("train")


if __name__ == "__main__":
    main()
