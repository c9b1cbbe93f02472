"""Run every benchmark, and write the table and `docs/benchmarks.md`: `make bench`.

With `--before FOLDER`, a checkout of an earlier commit with its own `.venv`, its `env.step` is measured
beside ours: `make bench BEFORE=../before`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import adapters
import cameras
import engines_agree
import growth
import learning
import live_view
import page
import reach
import repeatability
import side_by_side
import startup
import tasks
import throughput
from measure import RESULTS, Row, show, write


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--before", type=Path, help="checkout to compare `env.step` with")
    before = parser.parse_args().before
    rows: list[Row] = []
    if before is not None:
        rows += side_by_side.measure(before.resolve())
        write(rows)
    quick = (throughput, tasks, adapters, growth, cameras, reach, startup, repeatability)
    for benchmark in (*quick, learning, live_view, engines_agree):
        print(f"{benchmark.__name__} ...", flush=True)
        rows += benchmark.measure()
        # Write after each benchmark, so that a stopped run keeps its results.
        write(rows)
    print(show(rows))
    print(f"\nWritten to {RESULTS / 'table.md'} and {page.write_page()}")


if __name__ == "__main__":
    main()
