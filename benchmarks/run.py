"""Run every benchmark and write the table: `make bench`."""

from __future__ import annotations

import cameras
import engines_agree
import learning
import live_view
import reach
import repeatability
import startup
import tasks
import throughput
import walking
from report import RESULTS, Row, show, write


def main() -> None:
    rows: list[Row] = []
    quick = (throughput, tasks, cameras, reach, startup, repeatability)
    for benchmark in (*quick, learning, live_view, walking, engines_agree):
        print(f"{benchmark.__name__} ...", flush=True)
        rows += benchmark.measure()
        # Written after each, so that a run that is stopped has left what it measured.
        write(rows)
    print(show(rows))
    print(f"\nWritten to {RESULTS / 'table.md'}")


if __name__ == "__main__":
    main()
