"""Train a task with several seeds: `uv run mjlab train-seeds TASK [--seeds N] [flags of train]`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjlab.cli.devices import NO_GPU
from mjlab.cli.flags import is_given, parse_own_flags
from mjlab.cli.main import run_alias
from mjlab.cli.train_process import run_forwarding_signals, train_command
from mjlab.utils.errors import BadCallError, UserError
from mjlab.utils.gpu import select_gpus
from mjlab.utils.logging import print_notice
from mjlab.utils.ranges import Range
from mjlab.utils.signals import (
    Interrupted,
    interrupting_signal,
)


@dataclass
class SeedsFlags:
    """Flags of `train-seeds`. All others are those of `train`."""

    seeds: Annotated[int, Range(1, 10_000)] = 5
    """Number of seeds 1, 2, ..., trained one after another."""


def command(argv: list[str], prog: str) -> None:
    """Run `train-seeds`."""
    count, flags = _parse(argv, prog)
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


def _parse(argv: list[str], prog: str) -> tuple[int, list[str]]:
    """Return the number of seeds, and the flags of `train`.

    Exits on invalid flags and on `--help`.
    """
    from mjlab.cli.train_config import check_typed_flags, parse_train_flags

    task, *words = argv
    own, flags = parse_own_flags(SeedsFlags(), words, f"{prog} {task}")
    cfg = parse_train_flags(task, flags, prog=f"{prog} {task}")
    check_typed_flags(cfg, flags)
    for flag in ("--seed", "--agent.seed", "--agent.run-name"):
        if is_given(flag, flags):
            raise BadCallError(
                f"{flag}: expected no value, because runs use the seeds 1, 2, ... and are named after them; "
                "use --seeds N for the number of seeds, or `train` for one run."
            )
    if cfg.device is None and cfg.gpu_ids and select_gpus(cfg.gpu_ids)[0] is None:
        # Once, not once per seed.
        print_notice(NO_GPU)
        flags = [*flags, "--device", "cpu"]
    return own.seeds, flags


def main() -> None:
    """Entry point of `train-seeds`."""
    run_alias("train-seeds")


if __name__ == "__main__":
    main()
