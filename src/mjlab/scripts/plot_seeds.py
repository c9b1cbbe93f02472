"""Draw runs that differ in their seed: `uv run plot-seeds RUN_FOLDER ... --output FILE.png`."""

from __future__ import annotations

import argparse
from pathlib import Path

from mjlab.scripts.cli import UserError, run_command


def _command(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="plot-seeds",
        description="Draw the mean over runs, with one sample standard deviation shaded.",
    )
    parser.add_argument("runs", nargs="+", type=Path, help="folders of the runs")
    parser.add_argument("--output", type=Path, default=Path("seeds.png"), help="PNG to write")
    parser.add_argument("--tag", help="figure to draw, as TensorBoard calls it")
    parser.add_argument("--title", help="title of the plot")
    args = parser.parse_args(argv)
    missing = [str(run) for run in args.runs if not run.is_dir()]
    if missing:
        raise UserError(f"Not folders of runs: {', '.join(missing)}.")
    from mjlab.rl.plot import DEFAULT_TAG, plot_seeds

    path = plot_seeds(args.runs, args.output, tag=args.tag or DEFAULT_TAG, title=args.title)
    print(path)


def main() -> None:
    """Entry point of `plot-seeds`."""
    run_command(_command)


if __name__ == "__main__":
    main()
