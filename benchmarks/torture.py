"""Robustness tests: `make torture`, or `python benchmarks/torture.py --part kills ...`.

Runs families of trials with faults of users, machines and the network: signals at
random moments, damaged and hostile files, full disks, wrong flags, broken physics, malformed clients.
A trial holds if nothing fails silently, gets lost or hangs, and a command's error is one message
without a traceback. Prints the numbers of trials tried, held and failed by family, and each failure with the
command that repeats it. The exit status is 1 if a trial failed. Requires Linux.
"""

from __future__ import annotations

import argparse
import collections
import gc
import importlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from torture_parts.commands import preload  # noqa: E402 - found by the line above.
from torture_parts.trials import Verdict, run_trials  # noqa: E402

PARTS = (
    "kills", "evaluations", "resumes", "damage", "limits", "command_lines", "config_files",
    "physics", "page",
)  # fmt: skip
MINUTES = 15.0
"""Wall-clock minutes of all parts on two cores with the default numbers of trials."""


@dataclass
class Result:
    """The trials of one family."""

    family: str
    what: str
    seconds: float = 0.0
    tried: int = 0
    failed: list[Verdict] = field(default_factory=list)
    notes: collections.Counter[str] = field(default_factory=collections.Counter)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the parts that were asked for; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), help="families")
    parser.add_argument("--seed", type=int, default=0, help="seed of all trials")
    parser.add_argument(
        "--minutes", type=float, default=MINUTES, help="scales the numbers of trials (default: 15)"
    )
    parser.add_argument("--trial", type=int, help="only this trial, and what its commands print")
    parser.add_argument("--out", type=Path, help="Markdown file to write the table to")
    parser.add_argument(
        "--checkout", type=Path, default=ROOT, help="project to examine, such as an earlier one"
    )
    args = parser.parse_args(argv)
    if args.trial is not None and len(args.part) != 1:
        parser.error("--trial needs one --part")
    source = str(args.checkout.resolve() / "src")
    sys.path.insert(0, source)
    # Child processes must find the same files.
    paths = [source, *filter(None, [os.environ.get("PYTHONPATH")])]
    os.environ["PYTHONPATH"] = os.pathsep.join(paths)
    preload()
    # Forked processes share memory until one writes to it.
    gc.collect()
    gc.freeze()
    results = []
    # No TemporaryDirectory, which every forked process would remove at its exit.
    folder = Path(tempfile.mkdtemp(prefix="torture-"))
    try:
        # Temporary files of what is tried are removed with the rest.
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder / "tmp")
        os.mkdir(tempfile.tempdir)
        for part in args.part:
            results.append(run_part(part, args.seed, args.minutes, args.trial, folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    text = table(results, args.seed)
    print(f"\n{text}")
    if args.out is not None:
        args.out.write_text(text)
    return int(any(result.failed for result in results))


def run_part(part: str, seed: int, minutes: float, number: int | None, folder: Path) -> Result:
    """Run the trials of one family, or that of one `number`."""
    module = importlib.import_module(f"torture_parts.{part}")
    count = max(1, round(module.TRIALS * minutes / MINUTES))
    numbers = range(count) if number is None else [number]
    result = Result(part, module.WHAT)
    print(f"{part}: {module.WHAT} ({len(numbers)})", flush=True)
    begin = time.monotonic()
    trials = run_trials(part, module, numbers, seed, folder / part, show=number is not None)
    for verdict in trials:
        result.tried += 1
        result.notes.update(verdict.notes)
        if verdict.broken is not None:
            result.failed.append(verdict)
            print(f"  failed: {verdict.line(seed)}", flush=True)
        elif number is not None:
            print(f"  held: {verdict.what}", flush=True)
    result.seconds = time.monotonic() - begin
    result.failed.sort(key=lambda verdict: verdict.number)
    return result


def table(results: Sequence[Result], seed: int) -> str:
    """Return the numbers by family, the failures and the notes as Markdown."""
    lines = ["| family | tried | held | failed |", "| --- | ---: | ---: | ---: |"]
    tried = failed = 0
    for result in results:
        bad = len(result.failed)
        tried, failed = tried + result.tried, failed + bad
        lines.append(f"| {result.family} | {result.tried} | {result.tried - bad} | {bad} |")
    lines += [f"| all | {tried} | {tried - failed} | {failed} |", ""]
    took = ", ".join(f"{result.family} {result.seconds:.0f} s" for result in results)
    lines += [f"Seed {seed}. Took: {took}.", ""]
    for title, said in (
        ("Failed", [f"- {v.line(seed)}" for result in results for v in result.failed]),
        (
            "Noticed",
            [f"- {text} ({n} times)" for result in results for text, n in result.notes.items()],
        ),
    ):
        if said:
            lines += [f"{title}:", "", *said, ""]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
