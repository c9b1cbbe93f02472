"""Plot the mean over seeds: `uv run mjlab plot-seeds RUN ... [--group NAME RUN ...]`."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjlab.cli.main import run_alias
from mjlab.rl.config import EvaluationCfg
from mjlab.rl.plot import (
    DEFAULT_TAG,
    Curve,
    default_tag,
    mean_and_std,
    picture_path,
    plot_seeds,
    read_all_scalars,
    solved_at,
)
from mjlab.runs import Run
from mjlab.runs.reference import parts_of
from mjlab.utils.errors import BadCallError
from mjlab.utils.logging import print_notice
from mjlab.utils.tables import Table

# Longer lists of seeds are counted.
_LISTED_SEEDS = 8


@dataclass(frozen=True)
class Seed:
    """Run of a seed, with all its parts."""

    run: Run
    """Last part."""
    parts: list[Path]
    """Folders of all parts."""
    numbers: tuple[int, ...]
    """Seed, or seeds if a later part had another; empty if not recorded."""
    curves: dict[str, Curve]
    """Scalars of all parts, by tag."""

    @staticmethod
    def read(folder: Path) -> Seed:
        """Read the run whose last part is in `folder`.

        Raises:
            ValueError: no event files.
        """
        parts = parts_of(folder)
        numbers = [Run(part).seed for part in parts]
        known = tuple(dict.fromkeys(number for number in numbers if number is not None))
        return Seed(Run(folder), parts, known, read_all_scalars(parts))

    @property
    def iterations(self) -> int:
        """Number of iterations finished."""
        return 1 + max(
            (int(at[-1]) for tag, (at, _) in self.curves.items() if not tag.endswith("/time")),
            default=-1,
        )

    @property
    def evaluation(self) -> EvaluationCfg | None:
        """Conditions of a solved task, as recorded; None if they were not."""
        recorded = self.run.params["agent"].get("evaluation")
        return EvaluationCfg.of(recorded) if recorded else None


def command(argv: list[str], prog: str) -> None:
    """Run `plot-seeds`."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Plot the mean over runs with different seeds, with one sample standard deviation "
        "shaded, and print a table.",
    )
    parser.add_argument("runs", nargs="*", type=Path, help="run folders")
    parser.add_argument(
        "--group", nargs="+", action="append", default=[], metavar=("NAME", "RUN"),
        help="name and run folders of a curve; several --group: several curves",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, default=Path("seeds.png"), help="output PNG")
    parser.add_argument(
        "--tag", help="TensorBoard tag to plot; default: the return, and errors that solve the task"
    )
    parser.add_argument("--title", help="title of the plot")
    args = parser.parse_intermixed_args(argv)
    output = picture_path(args.output, "--output")
    named: dict[str, list[Path]] = {"": args.runs} if args.runs else {}
    for name, *runs in args.group:
        if not runs:
            raise BadCallError(f"--group {name}: expected a name and run folders, got a name only.")
        named.setdefault(name, []).extend(map(Path, runs))
    if not named:
        raise BadCallError("plot-seeds: expected run folders, got none.")
    groups = {name: distinct_seeds(name, folders) for name, folders in named.items()}
    every = [seed for seeds in groups.values() for seed in seeds]
    tag = args.tag or default_tag([seed.curves for seed in every])
    path = plot_seeds(
        {name: [seed.parts for seed in seeds] for name, seeds in groups.items()},
        output,
        tag=args.tag,
        title=args.title,
        goal=common_goal(every, tag),
        evaluation=common_evaluation(every),
    )
    print(f"{seeds_table(groups, tag).text()}\n")
    print(path)


def distinct_seeds(group: str, folders: Sequence[Path]) -> list[Seed]:
    """Return the runs in `folders`, one for each seed.

    A run that another one continues is part of that one. Of several runs of a seed, the one with the
    most iterations counts; a notice names them. Runs without a recorded seed count as distinct.

    Raises:
        ValueError: no event files.
    """
    of = f" of {group!r}" if group else ""
    read = {folder.resolve(): Seed.read(folder) for folder in folders}
    continued = {part for seed in read.values() for part in seed.parts[:-1]}
    seeds = [seed for folder, seed in read.items() if folder not in continued]
    by_number: dict[tuple[int, ...], list[Seed]] = {}
    for position, seed in enumerate(seeds):
        by_number.setdefault(seed.numbers or (-1 - position,), []).append(seed)
    for numbers, same in by_number.items():
        same.sort(key=lambda seed: seed.iterations)
        if len(same) > 1:
            others = ", ".join(str(seed.run.folder) for seed in same[:-1])
            print_notice(
                f"Seed {_joined(numbers)}{of} has {len(same)} runs, which are not "
                f"{len(same)} seeds: only {same[-1].run.folder} is drawn, not {others}."
            )
    kept = [same[-1] for same in by_number.values()]
    if different := _differences([seed.run for seed in kept]):
        print_notice(
            f"The runs{of} differ in {', '.join(different)}, not only in their seeds; use --group for each."
        )
    return kept


def _differences(runs: Sequence[Run]) -> list[str]:
    """Return `task`, and the settings that were given to some of `runs` and differ between them."""
    is_mixed = len({run.task for run in runs} - {None}) > 1
    paths = {"env.scene.num_envs"}.union(*(run.info.get("settings") or {} for run in runs))
    # More iterations of the same.
    paths.discard("agent.max_iterations")
    different = [p for p in sorted(paths) if len({str(run.recorded(p)) for run in runs}) > 1]
    return [*(["task"] if is_mixed else []), *different]


def common_evaluation(seeds: Sequence[Seed]) -> EvaluationCfg | None:
    """Return the conditions of a solved task, None if the runs have different ones."""
    first = seeds[0].evaluation
    return first if all(seed.evaluation == first for seed in seeds) else None


def common_goal(seeds: Sequence[Seed], tag: str) -> float | None:
    """Return the goal of all runs for `tag`; None if they have none, or different ones."""
    from mjlab.rl.evaluation import Bound

    name = "mean_return" if tag == DEFAULT_TAG else tag.removeprefix("Evaluation/")
    goals = {
        next(
            (b.limit for b in Bound.all_of(EvaluationCfg.of(seed.evaluation)) if b.name == name),
            None,
        )
        for seed in seeds
    }
    return goals.pop() if len(goals) == 1 else None


def seeds_table(groups: Mapping[str, Sequence[Seed]], tag: str) -> Table:
    """Return a table with one row per group: mean and sample standard deviation of `tag` at the last
    iteration that all its runs have, and the iterations at which they were solved.
    """
    value = "return" if tag == DEFAULT_TAG else tag.rpartition("/")[2]
    columns = ("group", "seeds", "iterations", "at", value, "std", "solved", "solved at")
    rows: list[list[Any]] = []
    for name, seeds in groups.items():
        at, mean, std = mean_and_std([seed.curves[tag] for seed in seeds])
        goals = [(seed, cfg) for seed in seeds if (cfg := seed.evaluation) is not None]
        solved = [n for seed, cfg in goals if (n := solved_at(seed.curves, cfg)) is not None]
        listed = [_joined(seed.numbers) for seed in seeds if seed.numbers]
        is_short = 0 < len(listed) == len(seeds) <= _LISTED_SEEDS
        rows.append(
            [
                name or None,
                ", ".join(sorted(listed)) if is_short else str(len(seeds)),
                _span([seed.iterations for seed in seeds]),
                int(at[-1]) + 1 if len(at) else None,
                float(mean[-1]) if len(at) else None,
                float(std[-1]) if len(at) and len(seeds) > 1 else None,
                f"{len(solved)} of {len(goals)}" if goals else None,
                _span(solved),
            ]
        )
    shown = [k for k in range(len(columns)) if any(row[k] is not None for row in rows)]
    return Table(
        "seeds", tuple(columns[k] for k in shown), [[row[k] for k in shown] for row in rows]
    )


def _joined(numbers: Sequence[int]) -> str:
    return " then ".join(map(str, numbers))


def _span(values: list[int]) -> str | None:
    """Return the range and the median: `29 to 45 (31)`."""
    if len(set(values)) < 2:
        return str(values[0]) if values else None
    return f"{min(values)} to {max(values)} (median {statistics.median(values):g})"


def main() -> None:
    """Entry point of `plot-seeds`."""
    run_alias("plot-seeds")


if __name__ == "__main__":
    main()
