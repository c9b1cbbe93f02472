"""See where the time of a task's steps goes: `uv run profile-env TASK [flags]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import run_command, task_and_flags, task_usage

if TYPE_CHECKING:
    from mjlab.scripts.profile_env_run import ProfileConfig as ProfileConfig

_USAGE = task_usage(
    "profile-env",
    "Step a task with random actions, and print the time of a step by phase (physics, forward, each "
    "manager) and by term.",
    [
        "profile-env Mjlab-Cartpole-Swingup",
        "profile-env Mjlab-Cartpole-Swingup --num-envs 4096 --steps 200 --json",
    ],
)


def __getattr__(name: str) -> Any:
    if name in ("ProfileConfig", "run_profile_env"):
        from mjlab.scripts import profile_env_run

        return getattr(profile_env_run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _command(argv: list[str]) -> None:
    task, flags = task_and_flags(argv, _USAGE)
    from mjlab.scripts.policy import parse_policy_flags
    from mjlab.scripts.profile_env_run import ProfileConfig, run_profile_env

    cfg = parse_policy_flags(ProfileConfig, flags, task, "profile-env", purpose="train")
    run_profile_env(task, cfg)


def main() -> None:
    """Entry point of `profile-env`."""
    run_command(_command)


if __name__ == "__main__":
    main()
