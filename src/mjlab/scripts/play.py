"""Watch a policy: `uv run play TASK [flags]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.compat import older_names
from mjlab.scripts.cli import run_command, task_and_flags, task_usage

if TYPE_CHECKING:
    from mjlab.scripts.play_run import PlayConfig as PlayConfig

_USAGE = task_usage(
    "play",
    "Show a trained policy (the newest, unless one is named) in the browser, in MuJoCo's window, "
    "or as a video.",
    [
        "play Mjlab-Cartpole-Swingup",
        "play Mjlab-Cartpole-Swingup --checkpoint-file logs/rsl_rl/cartpole/model_500.pt",
        "play Mjlab-Cartpole-Swingup --agent random --viewer native",
        "play Mjlab-Cartpole-Swingup --viewer none --num-steps 200 --video True",
    ],
)


def __getattr__(name: str) -> Any:
    if name in ("PlayConfig", "run_play"):
        from mjlab.scripts import play_run

        return getattr(play_run, name)
    return older_names(__name__)(name)


def _command(argv: list[str]) -> None:
    task, flags = task_and_flags(argv, _USAGE)
    from mjlab.scripts.play_run import PlayConfig, run_play
    from mjlab.scripts.policy import parse_policy_flags

    run_play(task, parse_policy_flags(PlayConfig, flags, task, "play", purpose="play"))


def main() -> None:
    """Entry point of `play`."""
    run_command(_command)


if __name__ == "__main__":
    main()
