"""Train a task: `uv run mjlab train TASK [flags]`."""

from __future__ import annotations

import contextlib
import copy
import signal
import sys
from collections.abc import Generator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.cli.devices import gpus_to_share, training_device
from mjlab.cli.flags import (
    is_given,
    options_of,
    prepare_env_cfg,
    report_untuned_learner,
    suggest_profile,
    typed_values,
)
from mjlab.cli.main import run_alias
from mjlab.cli.policy_flags import prepare_teacher
from mjlab.cli.resume import (
    check_learner_resumes,
    checkpoint_to_resume,
    choose_seed,
    is_finished,
    restore_num_envs,
    run_to_continue,
    with_settings_of,
)
from mjlab.cli.train_config import (
    TrainConfig,
    check_flags,
    check_typed_flags,
    parse_train_flags,
    report_moved_goal,
)
from mjlab.cli.training import evaluation_env_cfg, training_env, training_runner
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
from mjlab.runs import Checkpoint, Run
from mjlab.runs.folder import (
    NewRunFolder,
    SharedRunFolder,
    exit_by_signal,
    resumed_entry,
    write_info,
    write_params,
)
from mjlab.runs.policy import has_foreign_runner
from mjlab.runs.run import RunCfg
from mjlab.runs.settings import Settings, differences, is_of_the_session, typed_settings
from mjlab.utils.lazy import import_to_stay
from mjlab.utils.logging import beside_results, print_list, print_notice
from mjlab.utils.os import to_plain
from mjlab.utils.processes import ProcessRank, end_with_launcher, machine, process_rank
from mjlab.utils.ranges import check_ranges
from mjlab.utils.signals import Interrupted

if TYPE_CHECKING:
    from mjlab.cli.live import LiveView

__getattr__ = older_names(__name__)


def command(argv: list[str], prog: str) -> None:
    """Run `train`; with several GPUs, start one process per GPU."""
    task, *flags = argv
    cfg = parse_train_flags(task, flags, prog=f"{prog} {task}")
    check_typed_flags(cfg, flags)
    gpus = gpus_to_share(cfg)
    if not gpus:
        if (stopped := train_until_stopped(task, cfg, flags)[1]) is not None:
            raise Interrupted(stopped)
        return
    check_flags(cfg, typed_values(flags))
    # CUDA_VISIBLE_DEVICES restricts the workers to the selected GPUs.
    workers = [sys.executable, "-m", "mjlab.scripts.train", task, *flags, "--gpu-ids", "all"]
    launch_workers(workers, len(gpus), {"CUDA_VISIBLE_DEVICES": ",".join(map(str, gpus))})


def launch_training(task: str, cfg: TrainConfig) -> Path:
    """Train `task` with the flags `cfg`; return the run folder.

    Differences of `cfg` from the task count as typed flags; a resumed run keeps its other settings.
    Signals that interrupt training, as in `MjlabOnPolicyRunner.learn`, do not end the caller.
    If the run to resume has finished all iterations, return its folder without training. A run that
    fails before its first iteration leaves no folder.

    Raises:
        UserError, ValueError, OSError, CheckpointError, EngineUnavailableError: the request cannot be
            fulfilled; raised before training starts if possible.
    """
    return train_until_stopped(task, cfg)[0]


run_train = launch_training


def train_until_stopped(
    task: str, cfg: TrainConfig, flags: list[str] | None = None
) -> tuple[Path, signal.Signals | None]:
    """Train as `launch_training`; return the run folder, and the signal that interrupted training.

    `flags` is the command line that gave `cfg`, with the settings of a resumed run. None: `cfg` was
    made in Python.
    """
    end_with_launcher()
    rank = process_rank()
    # Only the first process prints the device. All report the processes they wait for.
    with output_of(rank):
        device = training_device(cfg, rank)
    with joined_processes(device), output_of(rank) as output:
        with fail_together():
            # What a program of a package says counts as a package's config.
            check_flags(cfg, typed_values(flags or []))
        if flags is not None:
            # Imports rsl_rl, and torch's compiler.
            import_to_stay("mjlab.rl.runner")
        return _train(task, cfg, flags, device, rank, output)


def _train(
    task: str,
    cfg: TrainConfig,
    flags: list[str] | None,
    device: str,
    rank: ProcessRank,
    output: ProcessOutput | None,
) -> tuple[Path, signal.Signals | None]:
    # Imports rsl_rl, which takes seconds; flags are checked before.
    from mjlab.cli.results import print_heading, report_divergence, write_results

    # One process looks up the checkpoint, before the new run folder could be found.
    path = broadcast_from_first(
        lambda: None if (found := checkpoint_to_resume(task, cfg)) is None else found.path
    )
    checkpoint = None if path is None else Checkpoint(path)
    run = None if path is None else Run(path.parent, task, cfg.learner_name)
    if run is not None and run.state == "running" and rank.is_first:
        print_notice(f"{run.folder} is still running; its last checkpoint is resumed.")
    like = None if cfg.like is None else run_to_continue(task, cfg)
    typed = _typed(task, cfg, flags)
    source = run or like
    # A command line was parsed with the settings of the run, unless the run was unknown.
    is_parsed = flags is not None and cfg.wandb_run_path is None
    if source is not None and not is_parsed and not cfg.as_registered:
        with_settings_of(source, cfg, typed)
        check_ranges(cfg, ())
    if run is not None and run.seed is not None and "agent.seed" not in typed:
        cfg.agent.seed = run.seed
    if cfg.seed is not None:
        cfg.agent.seed = cfg.seed
    if cfg.agent.seed == -1:
        cfg.agent.seed = broadcast_from_first(lambda: choose_seed(run))
    cfg.apply_short_forms(rank)
    if checkpoint is not None:
        if not has_foreign_runner(task):
            check_learner_resumes(cfg, checkpoint)
        if "env.scene.num_envs" not in typed:
            restore_num_envs(cfg, checkpoint)
    else:
        if like is not None and like.num_envs and "env.scene.num_envs" not in typed:
            cfg.env.scene.num_envs = like.num_envs
        suggest_profile(task, cfg.profile, device)
        if rank.is_first:
            report_untuned_learner(task, cfg.profile, cfg.learner_name)
    if rank.is_first:
        report_moved_goal(task, cfg)
    with fail_together():
        prepare_teacher(task, cfg.env, cfg.agent, run)
    with _run_folder(cfg, rank, output) as folder, contextlib.ExitStack() as stack:
        with fail_together():
            fetched_from = None if checkpoint is None else cfg.wandb_run_path
            requested = copy.deepcopy(cfg)
            # A run like another one also reads the files recorded with that one, such as motions.
            beside = path if like is None or like.newest is None else like.newest.path
            prepare_env_cfg(task, cfg, cfg.env, beside, fetched_from)
            if run is not None:
                run.check_terms(cfg.env, cfg.agent.obs_groups)
            view = None
            if cfg.live and rank.is_first and not has_foreign_runner(task):
                from mjlab.cli.live import live_view

                view = stack.enter_context(live_view(task, cfg))
            settings = settings_to_record(task, requested, typed, run)
            evaluated = evaluation_env_cfg(task, cfg, settings)
            env = training_env(cfg, device, folder.path, rank)
        try:
            print_heading(task, cfg, env, rank)
            if rank.is_first:
                _report_settings(cfg, run or like)
            with fail_together():
                runner = training_runner(task, cfg, env, folder.path, device, evaluated)
                if checkpoint is not None and run is not None:
                    checkpoint.load_into(runner)
                    _override(runner, typed, run)
                elif (teacher := getattr(cfg.agent, "teacher_checkpoint", None)) is not None:
                    runner.load_teacher(teacher)
            if checkpoint is not None:
                # Foreign runners train `max_iterations` more iterations.
                if not has_foreign_runner(task) and is_finished(cfg, runner, checkpoint):
                    return checkpoint.path.parent, None
                iteration = getattr(runner, "current_learning_iteration", "unknown")
                print(f"Resumed: {checkpoint}, iteration {iteration}")
            print(f"Run:     {folder.path}", flush=True)
            if rank.is_first:
                write_info(
                    folder.path,
                    task=task,
                    profile=cfg.profile,
                    learner=cfg.learner_name,
                    command=sys.argv,
                    started=datetime.now().isoformat(),
                    machine=machine(device),
                    settings=settings,
                    prepared=[
                        one.path for one in differences(cfg.env, to_plain(requested.env), "env")
                    ],
                    **({} if path is None else {"resumed": resumed_entry(folder.path, path)}),
                )
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


def _typed(task: str, cfg: TrainConfig, flags: list[str] | None) -> Settings:
    """Return the settings that were typed, number of environments and seed included."""
    registered = TrainConfig.from_task(task, cfg.profile, cfg.learner)
    given = {
        "agent.seed": (cfg.agent.seed, registered.agent.seed),
        "env.scene.num_envs": (cfg.env.scene.num_envs, registered.env.scene.num_envs),
    }
    if flags is None:
        found = {}
        for name in ("env", "agent"):
            recorded = to_plain(getattr(registered, name))
            found |= {one.path: one.now for one in differences(getattr(cfg, name), recorded, name)}
        found |= {path: now for path, (now, default) in given.items() if now != default}
    else:
        found = typed_settings(cfg.env, "env", flags) | typed_settings(cfg.agent, "agent", flags)
        found |= typed_settings(options_of(task, cfg), "options", flags)
        found |= {
            path: now
            for path, (now, _) in given.items()
            if is_given(f"--{path.replace('_', '-')}", flags)
        }
    short = {"env.scene.num_envs": cfg.num_envs, "agent.seed": cfg.seed}
    return found | {path: value for path, value in short.items() if value is not None}


def settings_to_record(task: str, cfg: TrainConfig, typed: Settings, run: Run | None) -> Settings:
    """Return the settings to record: those of the resumed run, updated by those of `cfg`."""
    registered = TrainConfig.from_task(task, cfg.profile, cfg.learner)
    parts = [
        (cfg.env, registered.env, "env"),
        (cfg.agent, registered.agent, "agent"),
        (options_of(task, cfg), options_of(task, None), "options"),
    ]
    changed = {
        one.path: one.now
        for own, default, name in parts
        for one in differences(own, to_plain(default), name)
    }
    hidden = {f"options.{name}" for name in options_of(task, cfg).unrecorded}
    typed = {path: value for path, value in typed.items() if not is_of_the_session(path)}
    # Last, because a typed path may have been resolved since.
    now = typed | changed
    before = {} if run is None or cfg.as_registered else run.settings
    # A term or dict set as a whole replaces earlier settings of its entries.
    kept = {
        path: value
        for path, value in before.items()
        if not any(path == new or path.startswith(f"{new}.") for new in now)
    }
    found = kept | now
    return {path: value for path, value in found.items() if path not in hidden}


def _report_settings(cfg: TrainConfig, run: Run | None) -> None:
    """Print how configs with the settings of `run` differ from the registered task."""
    if run is not None:
        left_out = {} if cfg.as_registered else run.cfg("train").left_out
        resolved = RunCfg(env=cfg.env, agent=cfg.agent, left_out=left_out)
        lines = run.notes("train", resolved, cfg.profile)
        print_list(f"Settings of {run.folder.name} and of this command:", lines)


def _override(runner: Any, typed: Settings, run: Run) -> None:
    """Let typed flags of the learner replace what the checkpoint restored.

    Flags with the values of `run` change nothing: job scripts type all flags at every restart, and
    the resumed run is the one that was interrupted.
    """
    changed = {
        path.removeprefix("agent."): value
        for path, value in typed.items()
        if path.startswith("agent.") and value != run.recorded(path)
    }
    if changed and not run.params["agent"]:
        print_notice(
            f"{run.folder}/params/agent.yaml is missing or unreadable: the flags "
            f"{', '.join(f'--agent.{name}' for name in changed).replace('_', '-')} count as changed."
        )
    # Runners of other packages restore what they restore.
    if changed and hasattr(runner, "override"):
        runner.override(changed)


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
        from mjlab.cli.display import show_training

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
        total = None if ended == "failed" else cfg.agent.max_iterations
        iterations = getattr(runner, "current_learning_iteration", total)
        if not is_shared:
            # On a full disk, do not mask the error that names the intact checkpoint.
            with beside_results("end of the run in run.json"):
                write_info(folder.path, ended=ended, iterations=iterations)
    return ended


def main() -> None:
    """Entry point of `train`."""
    run_alias("train")


if __name__ == "__main__":
    main()
