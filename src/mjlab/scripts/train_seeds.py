"""Train a task over several seeds: `uv run train-seeds TASK [--seeds N] [flags of train]`."""

from __future__ import annotations

import subprocess
import sys

from mjlab.scripts.cli import UserError, run_command, task_and_flags, task_usage

_USAGE = task_usage(
    "train-seeds",
    "Train a task once for each seed 1, 2, ..., N (5 unless --seeds says otherwise), one run after "
    "the other, each to its last iteration. All other flags are those of `train`.",
    [
        "train-seeds Mjlab-Cartpole-Swingup --num-envs 512 --agent.max-iterations 100",
        "plot-seeds logs/rsl_rl/cartpole/*_seed_? --output swingup.png",
    ],
)


def _command(argv: list[str]) -> None:
    task, flags = task_and_flags(argv, _USAGE)
    count, flags = _take_count(flags)
    for seed in range(1, count + 1):
        print(f"\nSeed {seed} of {count}", flush=True)
        # Curves that are to be averaged have to be of one length, so no run stops early; flags
        # given by hand come last and win.
        command = [sys.executable, "-m", "mjlab.scripts.train", task]
        command += ["--agent.evaluation.solved-return", "None"]
        command += [*flags, "--agent.seed", str(seed), "--agent.run-name", f"seed_{seed}"]
        status = subprocess.run(command, check=False).returncode
        if status != 0:
            raise UserError(f"Training with seed {seed} ended with status {status}.")


def _take_count(flags: list[str]) -> tuple[int, list[str]]:
    if "--seeds" not in flags:
        return 5, flags
    position = flags.index("--seeds")
    value = flags[position + 1] if position + 1 < len(flags) else ""
    if not value.isdigit() or int(value) < 1:
        raise UserError(f"--seeds is {value!r}; give the number of seeds, such as --seeds 5.")
    return int(value), flags[:position] + flags[position + 2 :]


def main() -> None:
    """Entry point of `train-seeds`."""
    run_command(_command)


if __name__ == "__main__":
    main()
