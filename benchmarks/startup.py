"""Start-up time of the commands."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time

from measure import Row, show

REPEATS = 5


def run_time(*command: str) -> float:
    """Return the median time of a command, in seconds."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        subprocess.run([sys.executable, *command], capture_output=True, check=True)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def first_iteration() -> float:
    """Return the median time from `train` to the first finished iteration."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(REPEATS):
            command = [sys.executable, "-u", "-m", "mjlab.cli.main", "train"]
            command += ["Mjlab-Cartpole-Swingup", "--num-envs", "512", "--device", "cpu"]
            command += ["--log-root", folder, "--agent.max-iterations", "1"]
            begin = time.perf_counter()
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("[1/1]"):
                    times.append(time.perf_counter() - begin)
            process.wait()
    return statistics.median(times)


def measure() -> list[Row]:
    """Measure all three; each is the median of several starts."""
    bare = run_time("-c", "pass")
    rows = []
    for name, command in (
        ("`list-envs`", ("-m", "mjlab.cli.main", "list-envs")),
        ("`train --help`", ("-m", "mjlab.cli.main", "train", "--help")),
    ):
        taken = run_time(*command)
        rows.append(
            Row(
                name, f"{taken:.2f} s", f"an empty Python: {bare:.2f} s", "under 0.7 s", taken < 0.7
            )
        )
    task_help = run_time("-m", "mjlab.cli.main", "train", "Mjlab-Cartpole-Swingup", "--help")
    torch_import = run_time("-c", "import torch")
    versus = f"`import torch` alone: {torch_import:.2f} s"
    rows.append(Row("`train TASK --help`", f"{task_help:.2f} s", versus, "", None))
    first = first_iteration()
    rows.append(
        Row(
            "`train`, 512 envs, to the first finished iteration",
            f"{first:.2f} s",
            versus,
            "under 8 s",
            first < 8,
        )
    )
    return rows


if __name__ == "__main__":
    print(show(measure()))
