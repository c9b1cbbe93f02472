"""Train a task with several seeds: `uv run train-seeds TASK [--seeds N] [flags of train]`."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import FrameType

from mjlab.scripts.cli import run_alias
from mjlab.scripts.devices import NO_GPU
from mjlab.scripts.flags import is_given
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.gpu import select_gpus
from mjlab.utils.logging import print_notice
from mjlab.utils.processes import PARENT_VARIABLE
from mjlab.utils.signals import (
    FORWARDED,
    Interrupted,
    handled_signals,
    interrupting_signal,
    send_signal,
    start_in_background,
)

_SEEDS_HELP = "--seeds N    Train with the seeds 1, 2, ..., N, sequentially (default: 5)."


def command(argv: list[str], prog: str) -> None:
    """Run `train-seeds`."""
    count, flags, experiment = _parse(argv, prog)
    for seed in range(1, count + 1):
        print(f"\nSeed {seed} of {count}", flush=True)
        # Averaged curves must have equal length, so runs must not stop when solved. User flags come
        # last and take precedence.
        to_the_end = ["--agent.evaluation.stop-when-solved", "False"]
        arguments = train_command(argv[0], [*to_the_end, *flags], seed)
        arguments += ["--agent.run-name", f"seed_{seed}"]
        status, received = run_forwarding_signals(arguments)
        # Others may have stopped the training process.
        if (stopped := received or interrupting_signal(status)) is not None:
            print(f"Stopped during seed {seed} of {count}; no other seed is trained.")
            raise Interrupted(stopped)
        if status != 0:
            raise UserError(f"Training with seed {seed} ended with status {status}.")


def _parse(argv: list[str], prog: str) -> tuple[int, list[str], Path]:
    """Return the number of seeds, the flags of `train`, and the folder of the runs.

    Exits on invalid flags and on `--help`.
    """
    from mjlab.scripts.train import parse_train_flags
    from mjlab.scripts.train_config import check_typed_flags

    task, *words = argv
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--seeds", nargs="?", default="5", const="")
    args, flags = parser.parse_known_args(words)
    count = read_count("--seeds", args.seeds)
    if "-h" in flags or "--help" in flags:
        print(f"{_SEEDS_HELP}\nAll other flags are those of `train`:\n", flush=True)
    cfg = parse_train_flags(task, flags, prog=f"{prog} {task}")
    check_typed_flags(cfg, flags)
    for flag in ("--agent.seed", "--agent.run-name"):
        if is_given(flag, flags):
            raise BadCallError(
                f"{flag}: expected no value, because runs use the seeds 1, 2, ... and are named after them; "
                "use --seeds N for the number of seeds, or `train` for one run."
            )
    if cfg.device is None and cfg.gpu_ids and select_gpus(cfg.gpu_ids)[0] is None:
        # Once, not once per seed.
        print_notice(NO_GPU)
        flags = [*flags, "--device", "cpu"]
    return count, flags, cfg.experiment_folder


def read_count(flag: str, text: str) -> int:
    """Return the value of a flag that counts something.

    Raises:
        UserError: the text is not an integer from 1 to 10,000.
    """
    # `int` raises for thousands of digits.
    if not (text.isdecimal() and len(text) <= 5 and 1 <= int(text) <= 10_000):
        raise UserError(f"{flag}: expected an integer in [1, 10000], got {text!r}.")
    return int(text)


def train_command(task: str, flags: list[str], seed: int) -> list[str]:
    """Return the command that trains `task` with `seed` in another process."""
    command = [sys.executable, "-m", "mjlab.scripts.train", task]
    return [*command, *flags, "--agent.seed", str(seed)]


def run_forwarding_signals(
    command: list[str], seconds: float | None = None
) -> tuple[int, signal.Signals | None]:
    """Run `command`; return its exit status, and the first stop signal that this process received.

    SIGINT, SIGTERM and SIGHUP do not end this process: each is forwarded to `command` once, and this
    process waits until `command` has ended, e.g. saved. After `seconds`, `command` receives SIGINT.
    """
    child: subprocess.Popen[bytes] | None = None
    received: list[signal.Signals] = []

    def forward(number: int, frame: FrameType | None = None) -> None:
        received.append(signal.Signals(number))
        if child is not None:
            send_signal(child, FORWARDED[number])

    with handled_signals(forward, FORWARDED):
        # A terminal sends Ctrl-C to all of its processes, and a second signal would give up the
        # running iteration.
        child = start_in_background(command, {**os.environ, PARENT_VARIABLE: str(os.getpid())})
        for number in tuple(received):
            send_signal(child, FORWARDED[number])
        try:
            status = child.wait(seconds)
        except subprocess.TimeoutExpired:
            if not received:
                send_signal(child, signal.SIGINT)
            status = child.wait()
    return status, received[0] if received else None


def main() -> None:
    """Entry point of `train-seeds`."""
    run_alias("train-seeds")


if __name__ == "__main__":
    main()
