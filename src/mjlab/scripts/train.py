"""Train a task: `uv run train TASK [flags]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.compat import older_names
from mjlab.scripts.cli import run_command, task_and_flags, task_usage

if TYPE_CHECKING:
    from mjlab.scripts.train_run import TrainConfig as TrainConfig

_USAGE = task_usage(
    "train",
    "Train a policy, by PPO or, with --learner sac, by SAC. Checkpoints, curves and the exported policy go to "
    "logs/rsl_rl/<experiment>/<time>/.",
    [
        "train Mjlab-Cartpole-Swingup --num-envs 4096",
        "train Mjlab-Cartpole-Swingup --agent.algorithm.learning-rate 3e-4 --agent.seed 1",
        "train Mjlab-Cartpole-Swingup --agent.resume True",
        "train Mjlab-Velocity-Flat-Unitree-Go1 --profile cpu",
        "train Mjlab-Velocity-Flat-Unitree-Go1 --learner sac --agent.algorithm.batch-size 1024",
    ],
)


def __getattr__(name: str) -> Any:
    # The parts behind the command line load torch; the command line itself does not.
    if name in ("TrainConfig", "launch_training", "run_train"):
        from mjlab.scripts import train_run

        return getattr(train_run, name)
    return older_names(__name__)(name)


def _command(argv: list[str]) -> None:
    task, flags = task_and_flags(argv, _USAGE)
    from mjlab.scripts.train_checks import check_flags, check_typed_flags
    from mjlab.scripts.train_run import launch_training, parse_train_flags
    from mjlab.scripts.training_device import gpus_to_share

    cfg = parse_train_flags(task, flags, prog=f"train {task}")
    check_typed_flags(cfg, flags)
    gpus = gpus_to_share(cfg)
    if not gpus:
        launch_training(task, cfg)
        return
    from mjlab.scripts.launcher import launch_workers, train_command

    check_flags(cfg)
    # Of the GPUs that they see, the processes use all.
    command = train_command(task, [*flags, "--gpu-ids", "all"])
    launch_workers(command, len(gpus), {"CUDA_VISIBLE_DEVICES": ",".join(map(str, gpus))})


def main() -> None:
    """Entry point of `train`."""
    run_command(_command)


if __name__ == "__main__":
    main()
