"""Duration of one step of a bundle's `runtime.py`, on one core.

    uv run mjlab deploy go1 --output go1_bundle
    uv run python benchmarks/deploy_step.py go1_bundle

Measurements and commands are those of the golden trace, with all limits. On a busy machine, steps wait for a
core; the time that the thread runs is that of a core of its own.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from mjlab.deploy.evidence import Evidence, Programs

STEPS = 20_000


def main() -> None:
    """Print median and 99 % quantile of both clocks."""
    folder = Path(sys.argv[1])
    evidence, runtime = Evidence(folder), Programs.load(folder).runtime
    policy = runtime.Policy.load(folder)
    rows = [(evidence.measured(k), evidence.command(k)) for k in range(len(evidence.first))]
    clocks = {"elapsed": time.perf_counter, "of the thread": time.thread_time}
    durations = {name: np.zeros(STEPS) for name in clocks}
    for k in range(STEPS):
        measured, command = rows[k % len(rows)]
        if evidence.first[k % len(rows)]:
            policy.reset()
        measured["time"] = k * policy.period
        starts = {name: clock() for name, clock in clocks.items()}
        targets = policy.step(measured, command)
        for name, clock in clocks.items():
            durations[name][k] = 1e3 * (clock() - starts[name])
        assert not targets.is_damping, targets.reason
    for name, values in durations.items():
        median, last = np.median(values), np.quantile(values, 0.99)
        print(f"{name}: median {median:.3f} ms, 99 % {last:.3f} ms, {STEPS} steps")


if __name__ == "__main__":
    main()
