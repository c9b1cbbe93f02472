"""Reference runs: stock tasks trained on several seeds, for `verify` and the documentation.

`make reference`, or `python benchmarks/reference.py --tasks Mjlab-Cartpole-Swingup --seeds 5`, trains one
seed after the other under the task's `cpu` profile, until the task is solved or `--minutes` are over, and
scores the last policy by `evaluate` on a seed not used in training. After each seed it writes

- `src/mjlab/reference/TASK.cpu.json` (or `gpu`), which ships with the package and is read by `verify`,
- `docs/reference/runs/index.md`, and the plot of the task next to it.

Seeds already in a file are kept. Interrupted ones are resumed; after a code change they are trained from
the start, because a seed belongs to one commit. `--again` replaces seeds of other commits.

Image tasks are trained under their `student` profile, with a teacher trained first.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import importlib.metadata
import json
import os
import shlex
import shutil
import sys
import time
import tomllib
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "benchmarks")]

from learning import EVALUATION_SEED  # noqa: E402
from measure import output_of  # noqa: E402

from mjlab.cli.devices import resolve_device  # noqa: E402
from mjlab.cli.resume import resume_flags  # noqa: E402
from mjlab.cli.train_process import run_forwarding_signals, train_command  # noqa: E402
from mjlab.rl.plot import LABELS, Curve, plot_curves  # noqa: E402
from mjlab.runs import Run  # noqa: E402
from mjlab.runs.reference import (  # noqa: E402
    DATA,
    METRIC,
    Kind,
    Reference,
    SeedRecord,
    read_run,
    reference_path,
    thinned,
    trained_seconds,
)
from mjlab.runs.run import DONE  # noqa: E402
from mjlab.tasks.registry import (  # noqa: E402
    UnknownTaskError,
    list_profiles,
    list_tasks,
    load_rl_cfg,
    require_task,
)
from mjlab.utils.errors import UserError  # noqa: E402
from mjlab.utils.processes import available_cores, processor  # noqa: E402
from mjlab.utils.string import counted  # noqa: E402

PAGES = ROOT / "docs" / "reference" / "runs"
PROFILE = "cpu"
STUDENT = "student"
TEACHER = [
    *("Mjlab-Lift-Cube-Yam", "--profile", PROFILE),
    # Students of one cube reach 69 to 84 % with such teachers, 39 to 51 % with those of mirror images.
    *("--agent.algorithm.symmetry-cfg", "None"),
    *("--agent.annealing", "((280,1.0),(300,0.25))"),
    *("--agent.evaluation.first-iteration", "250"),
]
"""Task and flags of the teacher of all students."""
# Without mirror images, seed 2 reached 94 and 92 %, seed 1 stayed at 79 %.
_TEACHER_SEED = 2
KINDS: tuple[Kind, ...] = ("cpu", "gpu")
MINUTES = 60.0
SEEDS = {"Mjlab-Cartpole-Swingup": 5}
"""Seeds of tasks that are trained in seconds; others have three."""
_FIRST, _INTERVAL = "--agent.evaluation.first-iteration", "--agent.evaluation.min-interval"
EVALUATION_FLAGS: dict[str, tuple[str, ...]] = {
    "Mjlab-Lift-Cube-Yam": (_FIRST, "250"),
    "Mjlab-Lift-Cube-Yam-Depth": (_FIRST, "200"),
    "Mjlab-Lift-Cube-Yam-Rgb": (_FIRST, "250"),
    "Mjlab-Multi-Cube-Seg-Yam": (_FIRST, "150"),
    "Mjlab-Reach-Yam": (_FIRST, "40"),
    "Mjlab-Tracking-Flat-Unitree-G1": (_FIRST, "450"),
    "Mjlab-Tracking-Flat-Unitree-G1-No-State-Estimation": (_FIRST, "450"),
    "Mjlab-Velocity-Flat-Unitree-G1": (_FIRST, "100"),
    "Mjlab-Velocity-Flat-Unitree-G1-No-State-Estimation": (_FIRST, "100"),
    "Mjlab-Velocity-Rough-Unitree-G1": (_INTERVAL, "60"),
    "Mjlab-Velocity-Rough-Unitree-G1-No-State-Estimation": (_INTERVAL, "60"),
    "Mjlab-Velocity-Rough-Unitree-Go1": (_FIRST, "500"),
    "Mjlab-Velocity-Rough-Unitree-Go1-No-State-Estimation": (_FIRST, "500"),
}
"""Flags of tasks whose evaluations would otherwise take as long as their training."""
CLIPS = {
    "Mjlab-Cartpole-Swingup": "swingup",
    "Mjlab-Lift-Cube-Yam": "lift",
    "Mjlab-Multi-Cube-Seg-Yam": "multi_cube",
    "Mjlab-Tracking-Flat-Unitree-G1": "g1_tracking",
    "Mjlab-Velocity-Flat-Unitree-G1-No-State-Estimation": "g1",
    "Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation": "go1",
    "Mjlab-Velocity-Rough-Unitree-G1": "g1_rough",
}
"""Clips of policies, of `tools/make_clips.py`."""
# For a task without the profile: tasks have one environment, and an evaluation of the cartpole takes the
# time of ten iterations.
_FLAGS = ["--num-envs", "512", "--agent.evaluation.min-interval", "6"]
# Evaluate from the first iteration, not only once training data suggest that the task is solved.
_EVALUATIONS = [
    *("--agent.evaluation.trigger-return", "-1e9"),
    *("--agent.evaluation.first-iteration", "0"),
]
_LIBRARIES = ("mujoco", "torch", "rsl-rl-lib")
_SETTINGS = "settings.json"


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings and output folders of reference runs."""

    device: str
    """Torch device."""
    minutes: float
    """Minutes of training per seed."""
    again: bool
    """Replace seeds of other commits."""
    flags: list[str]
    """Further flags of `train`."""
    episodes: int
    """Episodes of the final evaluation."""
    data: Path
    """Folder of the references."""
    pages: Path
    """Folder of the page and pictures."""
    log_root: Path
    """Folder of all runs, `KIND/TASK/seed_N` below it."""

    @property
    def kind(self) -> Kind:
        """Kind of device."""
        return "gpu" if self.device.startswith("cuda") else "cpu"


def make(task: str, seeds: int, options: Options) -> bool:
    """Train the missing seeds of a task; return False if interrupted.

    Raises:
        UserError: the task's file has seeds with other settings.
        RuntimeError: a command failed.
    """
    reference = _reference(task, options)
    commit = code_commit()
    for seed in range(1, seeds + 1):
        there = next((record for record in reference.seeds if record.seed == seed), None)
        if there is not None and not _is_stale(there, commit, options):
            print(f"{task}, seed {seed}: kept, of commit {there.commit}", flush=True)
            continue
        print(f"{task}, seed {seed} of {seeds}", flush=True)
        record = _train(reference, seed, commit, options)
        if record is None:
            print("Stopped. Run the same command to continue.")
            return False
        reference.put(record)
        reference.save(options.data)
        write_pages(options.data, options.pages, (task,))
    return True


def _is_stale(record: SeedRecord, commit: str, options: Options) -> bool:
    if options.again and record.commit != commit:
        return True
    return record.run.ended == "minutes" and record.minutes_limit < options.minutes


def _reference(task: str, options: Options) -> Reference:
    """Return the file of a task, or a reference without seeds."""
    profile = next((name for name in (STUDENT, PROFILE) if name in list_profiles(task)), None)
    bounds = load_rl_cfg(task, profile=profile).evaluation.trigger_below
    unbounded = [f for name in bounds for f in (f"--agent.evaluation.trigger-below.{name}", "inf")]
    flags = [
        *([] if profile else _FLAGS),
        *_EVALUATIONS,
        *unbounded,
        *EVALUATION_FLAGS.get(task, ()),
        *options.flags,
    ]
    teacher = [*TEACHER, "--agent.seed", str(_TEACHER_SEED)] if profile == STUDENT else []
    new = Reference(task=task, kind=options.kind, profile=profile, flags=flags, teacher=teacher)
    path = reference_path(options.data, task, options.kind)
    if not path.is_file():
        return new
    old = Reference.load(path)
    if (old.profile, old.flags, old.teacher) == (profile, flags, teacher):
        return old
    if options.again:
        return new
    raise UserError(
        f"{path} flags: expected {shlex.join([*new.train_flags, *new.teacher])}, got "
        f"{shlex.join([*old.train_flags, *old.teacher])}; "
        "use AGAIN=1 to replace all of its seeds."
    )


def _train(reference: Reference, seed: int, commit: str, options: Options) -> SeedRecord | None:
    """Train a seed, or the rest of it, and score it; None on a stop signal."""
    folder = options.log_root / options.kind
    trained = [reference.task, *reference.train_flags]
    if reference.teacher:
        teacher = _run(TEACHER, _TEACHER_SEED, commit, folder / "teacher", options)
        if teacher is None:
            return None
        if Run(teacher).state not in DONE:
            raise RuntimeError(
                f"The teacher, {teacher}: expected a finished run, got one of {options.minutes:g} minutes; "
                "use more --minutes."
            )
        trained += ["--agent.teacher-checkpoint", str(Run(teacher).newest)]
    run = _run(trained, seed, commit, folder / reference.task / f"seed_{seed}", options)
    if run is None:
        return None
    record = read_run(run)
    if record.ended not in DONE:
        record = dataclasses.replace(record, ended="minutes")
    return SeedRecord(
        seed=seed,
        commit=commit,
        versions=versions(),
        machine=machine(options.device),
        minutes_limit=options.minutes,
        run=thinned(record),
        evaluation=_score(reference, run, EVALUATION_SEED + seed, options),
    )


def _run(trained: list[str], seed: int, commit: str, folder: Path, options: Options) -> Path | None:
    """Train a task with flags, `trained`, or the rest; return the run in `folder`, None on a stop signal."""
    _clear_unless_same(folder, {"commit": commit, "trained": trained, "seed": seed})
    run = _newest_run(folder)
    left = 60.0 * options.minutes - (trained_seconds(run) if run else 0.0)
    if left > 0 and (run is None or Run(run).state not in DONE):
        command = train_command(trained[0], trained[1:], seed)
        command += ["--device", options.device, "--log-root", str(folder)]
        if run is not None:
            command += resume_flags(run)
        begin = time.monotonic()
        status, stopped = run_forwarding_signals(command, left)
        run = _newest_run(folder)
        ended = None if run is None else Run(run).state
        # A signal may have been sent to the training process alone.
        if stopped or (ended == "interrupted" and time.monotonic() - begin < left):
            return None
        # The status does not count: the time limit may have passed after training.
        if ended not in (*DONE, "interrupted"):
            raise RuntimeError(
                f"Training of {trained[0]}, seed {seed}, ended with status {status}."
            )
    assert run is not None
    return run


def _clear_unless_same(folder: Path, settings: dict[str, Any]) -> None:
    """Remove the runs in `folder`, unless made with the same settings."""
    marker = folder / _SETTINGS
    if marker.is_file() and json.loads(marker.read_text()) == settings:
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    marker.write_text(json.dumps(settings))


def _newest_run(folder: Path) -> Path | None:
    """Return the newest run with a checkpoint, in any experiment."""
    runs = (path for path in folder.glob("*/*/") if Run(path).checkpoints)
    return max(runs, key=lambda path: path.name, default=None)


def _score(reference: Reference, run: Path, seed: int, options: Options) -> dict[str, Any]:
    """Return the output of `evaluate` for the last policy of a run."""
    command = [sys.executable, "-m", "mjlab.scripts.evaluate", reference.task]
    command += ["--checkpoint-file", str(Run(run).newest), "--device", options.device]
    command += ["--num-episodes", str(options.episodes), "--seed", str(seed), "--json", "True"]
    # Flags of the environment apply to the evaluation too.
    flags = reference.flags
    for position, flag in enumerate(flags):
        if flag.startswith("--env."):
            command += flags[position : position + (1 if "=" in flag else 2)]
    printed = output_of(command)
    score = json.loads(printed[printed.index("{") :])
    # The path is local to this machine.
    del score["policy"]
    return score


def code_commit() -> str:
    """Return the last commit that changed the package, not its references, and a hash of later changes."""
    code = ["--", "src", "pyproject.toml", ":!src/mjlab/reference"]
    git = ["git", "-C", str(ROOT)]
    commit = output_of([*git, "log", "-1", "--format=%h", *code]).strip()
    changes = output_of([*git, "diff", "HEAD", *code])
    new_files = output_of([*git, "ls-files", "--others", "--exclude-standard", *code]).splitlines()
    changes += "".join((ROOT / name).read_text(errors="replace") for name in new_files)
    if not changes:
        return commit
    return f"{commit} with changes {hashlib.sha256(changes.encode()).hexdigest()[:7]}"


def versions() -> dict[str, str]:
    """Return the versions of this package and of libraries that affect results."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    libraries = {name: importlib.metadata.version(name) for name in _LIBRARIES}
    return {"mjlab": project["version"], **libraries}


def machine(device: str) -> dict[str, Any]:
    """Return a description of the machine."""
    gpu = None
    if device.startswith("cuda"):
        import torch

        gpu = torch.cuda.get_device_name(device)
    return {"cores": available_cores(), "processor": processor(), "gpu": gpu}


# The page.

_HEAD = """# Reference runs

Every stock task, trained under its `cpu` profile (image tasks: `student`, after the training of a teacher; without
one, with its default settings and 512 environments), each seed until its evaluations solve the task, or until its
time limit. `make reference` generates this page. [`uv run mjlab verify TASK`](../command_line.md#verify) trains one
more seed and compares it with these.

- **Samples**: environment steps, over all environments. **Minutes**: rollouts and updates, without evaluations.
  These runs are evaluated more often than others, to record curves; many from a later iteration on, in their
  command below, because an evaluation takes as long as minutes of training.
- **Final**: result of `evaluate` for the last policies, on seeds not used in training: the mean over seeds and, in
  brackets, the lowest and the highest end of their 95 % intervals. The table shows the metrics that solve the task;
  the sections show all.
- Clips may show other policies of a task, such as those of the demo.
- Curves: mean evaluation returns over seeds, with one sample standard deviation shaded. The last point of a run that
  ended between two evaluations is its final result.
"""


def write_pages(data: Path, pages: Path, tasks: tuple[str, ...] = ()) -> None:
    """Write the page of all references in `data`, and the plots of `tasks`."""
    pages.mkdir(parents=True, exist_ok=True)
    for task in tasks:
        _draw([reference for kind in KINDS if (reference := _load(data, task, kind))], pages)
    (pages / "index.md").write_text(page(data))


def page(data: Path) -> str:
    """Return the page of all references in `data`, as Markdown."""
    head = [
        "| task | CPU: samples | minutes | final | GPU: samples | minutes | final |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    rows, sections = [], []
    for task in stock_tasks():
        references = {kind: _load(data, task, kind) for kind in KINDS}
        made = [reference for reference in references.values() if reference and reference.seeds]
        name = f"[{task}](#{task.lower()})" if made else task
        cells = [cell for reference in references.values() for cell in _summary(reference)]
        rows.append(f"| {name} | {' | '.join(cells)} |")
        if made:
            sections.append(_section(task, made))
    return "\n".join([_HEAD, *head, *rows, "", *sections])


def stock_tasks() -> list[str]:
    """Return the tasks of the package."""
    return [task for task in list_tasks() if task.startswith("Mjlab-")]


def _load(data: Path, task: str, kind: Kind) -> Reference | None:
    path = reference_path(data, task, kind)
    return Reference.load(path) if path.is_file() else None


def _summary(reference: Reference | None) -> tuple[str, str, str]:
    """Return samples, minutes and final metrics of a reference, for the table."""
    if reference is None or not reference.seeds:
        return "not run", "", ""
    runs = [seed.run for seed in reference.seeds]
    final = "; ".join(
        f"{_words(name)} {_final(name, [seed.evaluation for seed in reference.seeds])}"
        for name in _deciding(reference)
    )
    solved = sum(run.ended == "solved" for run in runs)
    return (
        f"{_spread([run.samples / 1e6 for run in runs])} M",
        _spread([run.seconds / 60.0 for run in runs]),
        f"{solved} of {len(runs)} solved; {final}",
    )


def _deciding(reference: Reference) -> list[str]:
    """Return the metrics that solve the task, by default the return."""
    cfg = load_rl_cfg(reference.task, profile=reference.profile).evaluation
    names = [METRIC] if cfg.solved_return is not None else []
    names += [*cfg.solved_below, *cfg.solved_above]
    known = [name for name in names if _metric(reference.seeds[0].evaluation, name) is not None]
    return known or [METRIC]


def _section(task: str, references: list[Reference]) -> str:
    """Return the plot of a task, and a table of its seeds for each kind of device."""
    lines = [f"## {task}", "", f"![Curves of {task}]({task}.png)", ""]
    if task in CLIPS:
        lines += [f"![A policy of {task}](../../images/{CLIPS[task]}.webp)", ""]
    for reference in references:
        newest = reference.seeds[-1]
        names = _all_metrics(newest.evaluation)
        libraries = ", ".join(f"{name} {value}" for name, value in newest.versions.items())
        cores = f"{counted(newest.machine['cores'], 'core')} ({newest.machine['processor']})"
        where = ", ".join(filter(None, (newest.machine["gpu"], cores)))
        command = shlex.join([task, *reference.train_flags])
        if reference.teacher:
            teacher = shlex.join(reference.teacher)
            lines += [
                f"Teacher RUN: `uv run mjlab train {teacher}`. Its minutes are not included.",
                "",
            ]
            command += " --agent.teacher-checkpoint RUN"
        lines += [
            f"`uv run mjlab train {command}`, on {where}, {libraries}:",
            "",
            f"| seed | commit | ended | samples | minutes | steps/s | {' | '.join(map(_words, names))} |",
            f"|{' --- |' * (6 + len(names))}",
        ]
        for seed in reference.seeds:
            run = seed.run
            cells = [str(seed.seed), seed.commit, run.ended, f"{run.samples / 1e6:.3g} M"]
            cells += [f"{run.seconds / 60.0:.3g}", f"{run.steps_per_second:,.0f}"]
            cells += [_final(name, [seed.evaluation]) for name in names]
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _all_metrics(evaluation: dict[str, Any]) -> list[str]:
    rates = ("success_rate", "failure_rate")
    return [METRIC, *(r for r in rates if evaluation[r] is not None), *evaluation["metrics"]]


def _metric(evaluation: dict[str, Any], name: str) -> tuple[float, float, float] | None:
    """Return a metric of an evaluation with the ends of its interval; None if missing."""
    if name in evaluation["metrics"]:
        value, interval = evaluation["metrics"][name].values()
    else:
        value = evaluation.get(name)
        interval = evaluation.get(f"{name.removeprefix('mean_').removesuffix('_rate')}_interval")
    return None if value is None else (value, *(interval or (value, value)))


def _final(name: str, evaluations: list[dict[str, Any]]) -> str:
    """Return the mean of a metric over seeds, and the outermost ends of their intervals."""
    found = [metric for evaluation in evaluations if (metric := _metric(evaluation, name))]
    if not found:
        return ""
    values, lows, highs = zip(*found, strict=True)
    form = ".1%" if name.endswith("_rate") else ".3g" if name != METRIC else ",.0f"
    mean = sum(values) / len(values)
    return f"{mean:{form}} [{min(lows):{form}}, {max(highs):{form}}]"


def _spread(values: list[float]) -> str:
    """Return median and range, or the only value."""
    if len(values) == 1:
        return f"{values[0]:.3g}"
    return f"{median(values):.3g} ({min(values):.3g} to {max(values):.3g})"


def _words(name: str) -> str:
    return name.removeprefix("mean_").replace("_", " ")


def _draw(references: list[Reference], pages: Path) -> None:
    groups = {
        f"{reference.kind.upper()}, {counted(len(reference.seeds), 'seed')}": [
            _curve(seed) for seed in reference.seeds
        ]
        for reference in references
        if reference.seeds
    }
    task = references[0].task
    plot_curves(
        groups,
        pages / f"{task}.png",
        title=task,
        xlabel="Samples (millions)",
        ylabel=LABELS["Evaluation/mean_return"],
    )


def _curve(seed: SeedRecord) -> Curve:
    """Return millions of samples and mean returns of the evaluations, (n,) each.

    The final result comes last if the run ended between two evaluations.
    """
    samples, returns = seed.run.curve_in_millions()
    end = seed.run.samples / 1e6
    if len(samples) and samples[-1] == end:
        return samples, returns
    return np.append(samples, end), np.append(returns, seed.evaluation[METRIC])


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", help="tasks; default: all stock tasks")
    parser.add_argument("--seeds", type=int, help="seeds 1 to N; default: 3, swing-up: 5")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="time limit per seed")
    parser.add_argument("--again", action="store_true", help="replace seeds of other commits")
    parser.add_argument("--device", help="cpu, cuda:0, ...; default: a GPU if available")
    parser.add_argument("--flags", default="", help="further flags of `train`, in one word")
    parser.add_argument("--episodes", type=int, default=256, help="of the final evaluations")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the JSON files")
    parser.add_argument("--pages", type=Path, default=PAGES, help="folder of page and plots")
    parser.add_argument("--log-root", type=Path, default=ROOT / "logs" / "reference")
    parser.add_argument("--page-only", action="store_true", help="write the page without training")
    args = parser.parse_args()
    if args.page_only:
        drawn = [task for task in stock_tasks() if any(_load(args.data, task, k) for k in KINDS)]
        write_pages(args.data, args.pages, tuple(drawn))
        return 0
    # Run commands of this checkout, also if mjlab is installed elsewhere.
    os.environ["PYTHONPATH"] = os.pathsep.join(
        filter(None, (str(ROOT / "src"), os.environ.get("PYTHONPATH")))
    )
    failed = []
    try:
        options = Options(
            device=resolve_device(args.device),
            minutes=args.minutes,
            again=args.again,
            flags=shlex.split(args.flags),
            episodes=args.episodes,
            data=args.data,
            pages=args.pages,
            log_root=args.log_root.resolve(),
        )
        tasks = args.tasks or stock_tasks()
        for task in tasks:
            require_task(task)
        for task in tasks:
            try:
                if not make(task, args.seeds or SEEDS.get(task, 3), options):
                    raise KeyboardInterrupt
            except (UserError, RuntimeError) as error:
                # Continue with other tasks.
                print(f"error: {task}: {error}", file=sys.stderr, flush=True)
                failed.append(task)
    except KeyboardInterrupt:
        print("Stopped. Run the same command to continue.", file=sys.stderr)
        return 130
    except (UserError, UnknownTaskError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
