"""Verify an installation: train a seed and compare with a reference (`uv run mjlab verify TASK [flags]`)."""

from __future__ import annotations

import math
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mjlab.cli.devices import resolve_device
from mjlab.cli.flags import parse_flags
from mjlab.cli.main import run_alias
from mjlab.cli.resume import resume_flags
from mjlab.runs import Run, runs_in
from mjlab.runs.reference import (
    DATA,
    Comparison,
    Kind,
    NotEvaluatedError,
    Reference,
    RunRecord,
    compare,
    read_run,
    reference_path,
    referenced_tasks,
    samples_limit,
)
from mjlab.runs.run import DONE
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.ranges import Seed
from mjlab.utils.signals import Interrupted
from mjlab.utils.string import command_line, counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mjlab.cli.train_config import TrainConfig

_OUTSIDE = 1
# Rows of the printed table.
_ROWS = 5


@dataclass
class VerifyConfig:
    """Flags of `verify`."""

    seed: Seed = 0
    """Training seed. References use seeds >= 1, so 0 is a new seed."""
    device: str | None = None
    """Torch device: cpu, cuda:0, ... None: a GPU if available."""
    reference: str | None = None
    """Reference, a JSON file written by `make reference`. None: bundled reference of the task."""
    teacher_checkpoint: str | None = None
    """Teacher of a task that is learned from one, such as those of images: a run or checkpoint."""
    resume: bool = False
    """Resume the newest interrupted `verify` run of this task and seed."""
    log_root: str = "logs/rsl_rl"
    """Root folder of all runs."""


def load_reference(task: str, cfg: VerifyConfig) -> Reference:
    """Return the reference selected by `cfg`.

    Raises:
        UserError: reference not found, with a list of available ones; or of another task.
    """
    if cfg.reference is not None:
        reference = Reference.load(Path(cfg.reference))
        if reference.task != task:
            raise UserError(f"--reference: expected a reference of {task}, got {reference.task}.")
        return reference
    available = referenced_tasks(DATA)
    # Checked first, because the search for a GPU imports torch.
    if task in available:
        kind: Kind = "gpu" if resolve_device(cfg.device).startswith("cuda") else "cpu"
        if kind in available[task]:
            return Reference.load(reference_path(DATA, task, kind))
        missing = f"a reference of {task} on this kind of device, {kind}"
        use = f"--device {'cpu' if kind == 'gpu' else 'cuda'}"
    else:
        missing, use = f"a task with a reference, got {task!r}", "another task"
    listed = ", ".join(f"{name} ({', '.join(kinds)})" for name, kinds in available.items())
    raise UserError(
        f"verify: expected {missing}; use {use}. Available: {listed or 'none'}. In a checkout of "
        f"mjlab, `make reference TASKS={task}` creates one; --reference FILE reads it from a file."
    )


def _prepare(
    task: str, flags: list[str], prog: str
) -> tuple[VerifyConfig, Reference, TrainConfig, Path | None]:
    """Return flags, reference, training config, and the run folder if it has finished training."""
    cfg = parse_flags(VerifyConfig, VerifyConfig(), flags, f"{prog} {task}")
    reference = load_reference(task, cfg)
    resolve_device(cfg.device)
    if not reference.seeds:
        raise UserError(
            f"The reference of {task}: expected one seed or more, got none; use "
            f"`make reference TASKS={task}`."
        )
    if reference.teacher and cfg.teacher_checkpoint is None and not cfg.resume:
        raise UserError(
            f"verify {task}: expected a teacher, got none; use --teacher-checkpoint with a run of "
            f"`uv run mjlab train {command_line(reference.teacher)}`."
        )
    if cfg.seed in (seed.seed for seed in reference.seeds):
        # Allowed: the curve differs on other machines or with other library versions.
        print(f"Seed {cfg.seed} is part of the reference; its curve may be identical.")
    from mjlab.cli.train_config import parse_train_flags

    train_flags = [*reference.train_flags, "--agent.seed", str(cfg.seed)]
    train_flags += ["--agent.run-name", f"verify_seed_{cfg.seed}", "--log-root", cfg.log_root]
    train_flags += ["--agent.max-iterations", str(_iterations(reference))]
    train_flags += ["--device", cfg.device] if cfg.device is not None else []
    # A resumed run keeps its teacher.
    if cfg.teacher_checkpoint is not None and not cfg.resume:
        train_flags += ["--agent.teacher-checkpoint", cfg.teacher_checkpoint]
    done = None
    if cfg.resume:
        run_dir = _newest_run(task, cfg)
        # Raises for a missing session before training instead of after.
        _ = Run(run_dir).joined
        train_flags += resume_flags(run_dir)
        done = run_dir if Run(run_dir).state in DONE else None
    return cfg, reference, parse_train_flags(task, train_flags, f"{prog} {task}"), done


def _iterations(reference: Reference) -> int:
    """Return the iterations until a healthy seed is solved, or until the earliest last evaluation."""
    runs = [seed.run for seed in reference.seeds]
    limit = samples_limit(runs)
    if limit is None:
        return min(run.samples_at[-1] * run.iterations // run.samples for run in runs)
    return math.ceil(limit * runs[0].iterations / runs[0].samples)


def _newest_run(task: str, cfg: VerifyConfig) -> Path:
    from mjlab.tasks.registry import load_rl_cfg

    experiment = Path(cfg.log_root).resolve() / load_rl_cfg(task).experiment_name
    for run in runs_in(experiment, run_name=f"verify_seed_{cfg.seed}"):
        if run.task == task:
            return run.folder
    raise UserError(
        f"--resume: expected a run of `verify {task}` with seed {cfg.seed} in {experiment}, got "
        "none; leave out --resume to start a new run."
    )


def report(reference: Reference, run: RunRecord, comparison: Comparison) -> str:
    """Format the comparison."""
    versions, machines, commits = (
        "; ".join(dict.fromkeys(texts))
        for texts in (
            (", ".join(f"{n} {v}" for n, v in seed.versions.items()) for seed in reference.seeds),
            (
                one.get("gpu") or f"{counted(one['cores'], 'core')} ({one.get('processor')})"
                for one in (seed.machine for seed in reference.seeds)
            ),
            (seed.commit for seed in reference.seeds),
        )
    )
    speeds = [seed.run.steps_per_second for seed in reference.seeds]
    lines = [
        f"Reference  {counted(len(reference.seeds), 'seed')} on {machines}, commit {commits}, {versions}",
        f"Speed      {run.steps_per_second:,.0f} steps/s (collecting and learning); reference "
        f"{min(speeds):,.0f} to {max(speeds):,.0f}",
        "",
        f"{'samples':>12}  {'mean return':>12}  {'reference':>12}{'  band' if comparison.has_band else ''}",
    ]
    last = len(comparison.samples) - 1
    for row in range(_ROWS):
        i = round(row * last / (_ROWS - 1))
        middle, half = comparison.mean[i], comparison.half[i]
        band = f"  [{middle - half:.4g}, {middle + half:.4g}]" if comparison.has_band else ""
        outside = "" if comparison.within[i] else "   outside"
        lines.append(
            f"{comparison.samples[i]:>12,.0f}  {comparison.values[i]:>12.4g}  {middle:>12.4g}{band}{outside}"
        )
    if comparison.limit is not None:
        taken = sorted({seed.run.samples for seed in reference.seeds})
        spread = f"{taken[0]:,} to {taken[-1]:,}" if len(taken) > 1 else f"{taken[0]:,}"
        solved = comparison.solved_at
        lines += [
            "",
            f"Solved     {'not' if solved is None else f'after {solved:,} samples'}; reference after "
            f"{spread}, a healthy seed within {comparison.limit:,.0f}",
        ]
    elif not comparison.has_band:
        lines += [
            "",
            f"End        a healthy seed has a mean return of {comparison.least:.4g} or more",
        ]
    return "\n".join([*lines, ""])


def _draw(reference: Reference, run: RunRecord, comparison: Comparison, output: Path) -> Path:
    from mjlab.rl.plot import LABELS, plot_curves

    def draw(axes: Axes) -> None:
        edges = ((-1, "band of a new seed"), (1, None)) if comparison.has_band else ()
        for sign, label in edges:
            edge = comparison.mean + sign * comparison.half
            axes.plot(comparison.samples / 1e6, edge, "--", color="gray", lw=1, label=label)
        axes.plot(*run.curve_in_millions(), color="tab:red", marker=".", label="this run")
        if comparison.limit is not None:
            axes.axvline(comparison.limit / 1e6, color="gray", ls=":", label="solved by here")

    curves = [seed.run.curve_in_millions() for seed in reference.seeds]
    return plot_curves(
        {f"reference, {counted(len(curves), 'seed')}": curves},
        output,
        title=reference.task,
        xlabel="Samples (millions)",
        ylabel=LABELS["Evaluation/mean_return"],
        draw=draw,
    )


def command(argv: list[str], prog: str) -> None:
    """Run `verify`: exits 0 if the curve is within the band, 1 if not, 2 for invalid arguments.

    Raises:
        Interrupted: training was interrupted.
    """
    task, *flags = argv
    try:
        cfg, reference, train_cfg, run_dir = _prepare(task, flags, prog)
    except (UserError, ValueError, OSError) as error:
        raise BadCallError(str(error)) from error
    stopped = None
    if run_dir is None:
        from mjlab.scripts.train import train_until_stopped

        run_dir, stopped = train_until_stopped(task, train_cfg)
    try:
        run = read_run(run_dir)
    except NotEvaluatedError:
        if Run(run_dir).state in DONE:
            raise
        print("So far     no evaluation: the same command with --resume goes on.")
        raise Interrupted(stopped or signal.SIGINT) from None
    runs = [seed.run for seed in reference.seeds]
    comparison = compare(runs, run, reference.standard_error)
    print(f"\n{report(reference, run, comparison)}")
    print(f"Picture    {_draw(reference, run, comparison, run_dir / 'verify.png')}")
    part = f"{comparison.within.mean():.0%} of the way within the band, "
    often = "At most one healthy seed in twenty is"
    if not comparison.has_band:
        part, often = "", "The reference has fewer than three seeds, so a healthy one may be"
    if run.ended not in DONE:
        print(f"So far     {part}training was {run.ended}: the same command with --resume goes on.")
        raise Interrupted(stopped or signal.SIGINT)
    end = "its end" if comparison.limit is None else "the samples until it is solved"
    where = f"{part}{end} {'within' if comparison.ends_within else 'outside'}"
    if comparison.is_within:
        print(f"Verdict    within: {where}.")
        return
    print(
        f"Verdict    OUTSIDE: {where}. {often}; try --seed {cfg.seed + 1000} before you look for the "
        "reason."
    )
    sys.exit(_OUTSIDE)


def main() -> None:
    """Entry point of `verify`."""
    run_alias("verify")


if __name__ == "__main__":
    main()
