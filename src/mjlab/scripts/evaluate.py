"""Score a policy: `uv run evaluate TASK [flags]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import is_given, run_command, task_and_flags, task_usage

if TYPE_CHECKING:
    from mjlab.scripts.evaluate_run import EvaluateConfig as EvaluateConfig

_USAGE = task_usage(
    "evaluate",
    "Play episodes with a trained policy, one per environment, and print the mean return with a "
    "95 % interval, and the success rate where the task defines success.",
    [
        "evaluate Mjlab-Cartpole-Swingup",
        "evaluate Mjlab-Cartpole-Swingup --num-episodes 1024 --json True",
    ],
)


def __getattr__(name: str) -> Any:
    if name in ("EvaluateConfig", "run_evaluate"):
        from mjlab.scripts import evaluate_run

        return getattr(evaluate_run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _command(argv: list[str]) -> None:
    task, flags = task_and_flags(argv, _USAGE)
    from mjlab.scripts.evaluate_run import EvaluateConfig, run_evaluate
    from mjlab.scripts.policy import parse_policy_flags

    cfg = parse_policy_flags(EvaluateConfig, flags, task, "evaluate", purpose="evaluate")
    run_evaluate(task, cfg, keep_num_envs=is_given("--env.scene.num-envs", flags))


def main() -> None:
    """Entry point of `evaluate`."""
    run_command(_command)


if __name__ == "__main__":
    main()
