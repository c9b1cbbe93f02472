"""Profiles of tasks on the command line: `--profile cpu`, and the profile that a run was made with.

A profile changes the defaults that flags start from, so it is looked for before flags are parsed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from mjlab.scripts.cli import parse_flags, tell
from mjlab.scripts.run_folder import read_run_info
from mjlab.tasks.registry import list_profiles

C = TypeVar("C")

CPU_PROFILE = "cpu"
_FLAG = "--profile"


def parse_with_profile(
    make_default: Callable[[str | None], C],
    recorded: Callable[[C], str | None],
    flags: list[str],
    prog: str,
) -> C:
    """Return what `flags` make of the defaults under the profile that they name.

    Args:
        make_default: Returns the defaults under a profile, or for None without one.
        recorded: Returns, for what the flags make of the task's own defaults, the profile to use
            where the flags name none: that of the run at hand.
        flags: The command line.
        prog: The command, for messages.

    Raises:
        UnknownProfileError: the task has no such profile; the message lists those it has.
    """
    profile, is_given = asked_profile(flags)
    default = make_default(profile)
    cfg = parse_flags(type(default), default, flags, prog)
    if is_given:
        return cfg
    profile = recorded(cfg)
    if profile is None:
        return cfg
    default = make_default(profile)
    return parse_flags(type(default), default, flags, prog)


def asked_profile(flags: list[str]) -> tuple[str | None, bool]:
    """Return the profile that `flags` name, and whether they name one or say `None`."""
    profile, is_given = None, False
    for position, flag in enumerate(flags):
        name, equals, value = flag.partition("=")
        if name != _FLAG:
            continue
        if not equals:
            # Without a value, the parser has a message for it.
            value = flags[position + 1] if position + 1 < len(flags) else "None"
        profile, is_given = (None if value == "None" else value), True
    return profile, is_given


def profile_of_run(task: str, run_dir: Path) -> str | None:
    """Return the profile of `task` that the run in `run_dir` was made with, or None."""
    profile = read_run_info(run_dir).get("profile")
    if not isinstance(profile, str):
        return None
    if profile not in list_profiles(task):
        tell(
            f"The run in {run_dir} was made with the profile {profile!r}, which {task} does not "
            "have; the task's own settings are used."
        )
        return None
    return profile


def suggest_profile(task: str, profile: str | None, device: str) -> None:
    """Say in one line that there is a profile for training on a CPU, if it is of use here."""
    if profile is None and device == "cpu" and CPU_PROFILE in list_profiles(task):
        tell(
            f"Training on the CPU: `train {task} {_FLAG} {CPU_PROFILE}` has settings for a "
            "few cores."
        )
