"""Train a task: `uv run train TASK [flags]`."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.compat import older_names
from mjlab.rl.distributed import (
    ProcessOutput,
    broadcast_from_first,
    fail_together,
    joined_processes,
    launch_workers,
    log_file,
    output_of,
)
from mjlab.scripts.cli import run_alias
from mjlab.scripts.devices import gpus_to_share, training_device
from mjlab.scripts.environments import training_env, training_runner
from mjlab.scripts.flags import (
    parse_with_choices,
    prepare_env_cfg,
    report_untuned_learner,
    suggest_profile,
    with_task_options,
)
from mjlab.scripts.policy import has_foreign_runner, prepare_teacher
from mjlab.scripts.resume import (
    check_learner_resumes,
    checkpoint_to_resume,
    choices_to_resume,
    choose_seed,
    is_finished,
    restore_num_envs,
)
from mjlab.scripts.run_folder import (
    NewRunFolder,
    SharedRunFolder,
    exit_by_signal,
    write_params,
    write_resumed,
    write_run_info,
)
from mjlab.scripts.train_config import (
    TrainConfig,
    check_flags,
    check_typed_flags,
    report_moved_goal,
)
from mjlab.utils.processes import ProcessRank, end_with_launcher, process_rank
from mjlab.utils.signals import Interrupted

if TYPE_CHECKING:
    from mjlab.scripts.live import LiveView

__getattr__ = older_names(__name__)


def command(argv: list[str], prog: str) -> None:
    """Run `train`; with several GPUs, start one process per GPU."""
    task, *flags = argv
    cfg = parse_train_flags(task, flags, prog=f"{prog} {task}")
    check_typed_flags(cfg, flags)
    gpus = gpus_to_share(cfg)
    if not gpus:
        if (stopped := train_until_stopped(task, cfg)[1]) is not None:
            raise Interrupted(stopped)
        return
    check_flags(cfg)
    # CUDA_VISIBLE_DEVICES restricts the workers to the selected GPUs.
    workers = [sys.executable, "-m", "mjlab.scripts.train", task, *flags, "--gpu-ids", "all"]
    launch_workers(workers, len(gpus), {"CUDA_VISIBLE_DEVICES": ",".join(map(str, gpus))})


def parse_train_flags(task: str, flags: list[str], prog: str) -> TrainConfig:
    """Return the configuration of `task` updated by `flags`; exits on an unknown flag.

    Raises:
        UnknownProfileError: unknown profile.
        ValueError: the learner is unknown, or not supported by the task.
    """
    return parse_with_choices(
        lambda **choices: with_task_options(TrainConfig.from_task(task, **choices), task),
        lambda cfg, requested: choices_to_resume(task, cfg, requested),
        flags,
        prog,
    )


def launch_training(task: str, cfg: TrainConfig) -> Path:
    """Train `task` with the flags `cfg`; return the run folder.

    Signals that interrupt training, as in `MjlabOnPolicyRunner.learn`, do not end the caller. If the run to resume has finished all iterations, return its folder without training. A run that
    fails before its first iteration leaves no folder.

    Raises:
        UserError, ValueError, OSError, CheckpointError, EngineUnavailableError: the request cannot be
            fulfilled; raised before training starts if possible.
    """
    return train_until_stopped(task, cfg)[0]


run_train = launch_training


def train_until_stopped(task: str, cfg: TrainConfig) -> tuple[Path, signal.Signals | None]:
    """Train as `launch_training`; return the run folder, and the signal that interrupted training."""
    end_with_launcher()
    rank = process_rank()
    # Only the first process prints the device. All report the processes they wait for.
    with output_of(rank):
        device = training_device(cfg, rank)
    with joined_processes(device), output_of(rank) as output:
        with fail_together():
            check_flags(cfg)
        return _train(task, cfg, device, rank, output)


def _train(
    task: str, cfg: TrainConfig, device: str, rank: ProcessRank, output: ProcessOutput | None
) -> tuple[Path, signal.Signals | None]:
    # Imports rsl_rl, which takes seconds; flags are checked before.
    from mjlab.scripts.results import print_heading, report_divergence, write_results

    # One process looks up the checkpoint, before the new run folder could be found.
    checkpoint = broadcast_from_first(lambda: checkpoint_to_resume(task, cfg))
    if cfg.agent.seed == -1:
        cfg.agent.seed = broadcast_from_first(lambda: choose_seed(checkpoint))
    cfg.apply_short_forms(rank)
    if checkpoint is not None:
        if not has_foreign_runner(task):
            check_learner_resumes(cfg, checkpoint)
        restore_num_envs(task, cfg, checkpoint)
    else:
        suggest_profile(task, cfg.profile, device)
        if rank.is_first:
            report_untuned_learner(task, cfg.profile, cfg.learner_name)
    if rank.is_first:
        report_moved_goal(task, cfg)
    with fail_together():
        prepare_teacher(task, cfg.agent, checkpoint)
    with _run_folder(cfg, rank, output) as folder, contextlib.ExitStack() as stack:
        with fail_together():
            fetched_from = None if checkpoint is None else cfg.wandb_run_path
            prepare_env_cfg(task, cfg, cfg.env, checkpoint, fetched_from)
            view = None
            if cfg.live and rank.is_first and not has_foreign_runner(task):
                from mjlab.scripts.live import live_view

                view = stack.enter_context(live_view(task, cfg))
            env = training_env(cfg, device, folder.path, rank)
        try:
            print_heading(task, cfg, env, rank)
            with fail_together():
                runner = training_runner(task, cfg, env, folder.path, device)
                if checkpoint is not None:
                    runner.load(str(checkpoint))
                elif (teacher := getattr(cfg.agent, "teacher_checkpoint", None)) is not None:
                    runner.load_teacher(teacher)
            if checkpoint is not None:
                # Foreign runners train `max_iterations` more iterations.
                if not has_foreign_runner(task) and is_finished(cfg, runner, checkpoint):
                    return checkpoint.parent, None
                iteration = getattr(runner, "current_learning_iteration", "unknown")
                print(f"Resumed: {checkpoint}, iteration {iteration}")
            print(f"Run:     {folder.path}", flush=True)
            if rank.is_first:
                info = {"profile": cfg.profile, "learner": cfg.learner_name, "command": sys.argv}
                write_run_info(folder.path, task=task, **info)
                if checkpoint is not None:
                    write_resumed(folder.path, checkpoint)
                write_params(folder.path, cfg.env, cfg.agent)
            try:
                ended = _learn(task, cfg, runner, folder, view)
            finally:
                if rank.is_first:
                    report_divergence(env.unwrapped)
        finally:
            env.close()
    # The launcher takes processes that outlive an interrupted one for stuck.
    with fail_together():
        if rank.is_first:
            write_results(task, cfg, folder.path, device, ended)
    return folder.path, getattr(runner, "stop_signal", None)


@contextlib.contextmanager
def _run_folder(
    cfg: TrainConfig, rank: ProcessRank, output: ProcessOutput | None
) -> Generator[NewRunFolder | SharedRunFolder]:
    """Enter the run folder. The first process creates it for all."""
    with contextlib.ExitStack() as stack:
        new = NewRunFolder(cfg.experiment_folder, cfg.agent.run_name)
        stack.enter_context(exit_by_signal(unless=lambda: new.is_kept))
        path = broadcast_from_first(lambda: stack.enter_context(new).path)
        if output is not None:
            output.keep_in(log_file(rank, cfg.torchrunx_log_dir, path))
        yield new if rank.is_first else SharedRunFolder(path)


def _learn(
    task: str,
    cfg: TrainConfig,
    runner: Any,
    folder: NewRunFolder | SharedRunFolder,
    view: LiveView | None,
) -> str:
    """Train; return the stop reason."""
    is_shared = isinstance(folder, SharedRunFolder)
    if not is_shared:
        from mjlab.scripts.display import show_training

        show_training(task, cfg, runner, folder, view)
    ended = "failed"
    runner.grace = cfg.grace
    try:
        runner.learn(num_learning_iterations=cfg.agent.max_iterations, init_at_random_ep_len=True)
        # A custom runner may have a custom loop that does not call `on_start`.
        folder.keep()
        ended = "finished"
    finally:
        # Runners of other packages may have neither.
        ended = getattr(runner, "stop_reason", None) or ended
        iterations = getattr(runner, "current_learning_iteration", cfg.agent.max_iterations)
        if not is_shared:
            # On a full disk, do not mask the error that names the intact checkpoint.
            with contextlib.suppress(OSError):
                write_run_info(folder.path, ended=ended, iterations=iterations)
    return ended


def main() -> None:
    """Entry point of `train`."""
    run_alias("train")


if __name__ == "__main__":
    main()
