"""Choices that decide which other flags there are and what they start from: `--profile`, `--learner`.

Flags are parsed after them. A command that goes on with a run makes the choices of that run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from mjlab.scripts.cli import parse_flags, parse_known_flags, tell
from mjlab.scripts.run_folder import read_run_info
from mjlab.tasks.registry import list_profiles, load_rl_cfg

C = TypeVar("C")

CPU_PROFILE = "cpu"
_CHOICES = ("profile", "learner")


def parse_with_choices(
    make_default: Callable[..., C],
    recorded: Callable[[C, Mapping[str, str | None]], Mapping[str, str | None]],
    flags: list[str],
    prog: str,
) -> C:
    """Return what `flags` make of the defaults under the choices that they name.

    Args:
        make_default: Returns the defaults under choices, given as keywords; those not given are the
            task's.
        recorded: Returns the choices of the run at hand that differ from the task's. Its arguments
            are what the flags make of the defaults, and the choices that they name, which it need
            not look for.
        flags: The command line.
        prog: The command, for messages.

    Raises:
        UnknownProfileError: the task has no such profile; the message lists those it has.
        ValueError: the learner is unknown.
    """
    given = asked_choices(flags)
    default = make_default(**given)
    if len(given) == len(_CHOICES):
        return parse_flags(type(default), default, flags, prog)
    # The learner of the run at hand may have flags that the task's has not.
    cfg, unknown = parse_known_flags(type(default), default, flags, prog)
    choices = {**recorded(cfg, given), **given}
    if choices == given and not unknown:
        return cfg
    default = make_default(**choices)
    return parse_flags(type(default), default, flags, prog)


def asked_choices(flags: list[str]) -> dict[str, str | None]:
    """Return the choices that `flags` name; None where they say `None`."""
    choices: dict[str, str | None] = {}
    for position, flag in enumerate(flags):
        name, equals, value = flag.partition("=")
        name = name.removeprefix("--")
        if name not in _CHOICES or name == flag:
            continue
        if not equals:
            # Without a value, the parser has a message for it.
            value = flags[position + 1] if position + 1 < len(flags) else "None"
        choices[name] = None if value == "None" else value
    return choices


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
            f"Training on the CPU: `train {task} --profile {CPU_PROFILE}` has settings for a "
            "few cores."
        )


def tell_foreign_learner(task: str, profile: str | None, learner: str) -> None:
    """Say in one line that a profile has no settings for a learner, if it has those of another."""
    from mjlab.rl.learners import learner_of

    # A student is made like the profile's teacher.
    if profile is None or learner == "distillation":
        return
    tuned = learner_of(load_rl_cfg(task, profile=profile))
    if tuned != learner:
        tell(
            f"The profile {profile!r} of {task} has settings for the learner {tuned!r}: its environment "
            f"is used, while networks, algorithm and iterations of {learner!r} are those without it."
        )
