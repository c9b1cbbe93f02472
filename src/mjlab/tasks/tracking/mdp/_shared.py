"""Finding the command of a term and the bodies it looks at, with checks for when it is built."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch

from mjlab.tasks.tracking.mdp.motion_command import MotionCommand
from mjlab.tasks.tracking.mdp.motion_reader import MotionReader

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

# What terms read of a command, whose class may be a package's own.
_READ = (
    "anchor_pos_w",
    "anchor_quat_w",
    "robot_anchor_pos_w",
    "robot_anchor_quat_w",
    "body_pos_relative_w",
    "body_quat_relative_w",
    "robot_body_pos_w",
    "robot_body_quat_w",
)


def motion_command(env: ManagerBasedRlEnv, command_name: str) -> MotionCommand:
    """Return the motion command of that name."""
    # That it exists, and what it is, was checked when the term was built.
    manager: Any = env.command_manager
    return manager.get_term(command_name)


def check_motion_term(
    env: ManagerBasedRlEnv,
    command_name: str,
    body_names: tuple[str, ...] | None = None,
    std: float | None = None,
    threshold: float | None = None,
    **_: Any,
) -> None:
    """Check a term that reads a motion command.

    Raises:
        ValueError: there is no such command, a body is none of those it tracks, none is left, or
            `std` or `threshold` is not positive.
        TypeError: the command lacks what a `MotionCommand` has.
    """
    names = env.command_manager.active_terms
    if command_name not in names:
        raise ValueError(f"There is no command {command_name!r}. There are: {list(names)}.")
    manager: Any = env.command_manager
    command = manager.get_term(command_name)
    missing = [] if isinstance(command, MotionCommand) else _missing(command)
    if missing:
        raise TypeError(
            f"Command {command_name!r}: expected a MotionCommand or a term with its attributes, got "
            f"a {type(command).__name__} without {', '.join(missing)}."
        )
    body_columns(command, body_names)
    for label, value in (("std", std), ("threshold", threshold)):
        if value is not None and not value > 0.0:
            raise ValueError(f"{label} is {value!r}; it has to be positive.")


def _missing(command: Any) -> list[str]:
    # Listed rather than read: before the first reset, a property may have nothing to return.
    missing = sorted(set(_READ) - set(dir(command)))
    return missing if hasattr(command.cfg, "body_names") else [*missing, "cfg.body_names"]


def body_columns(command: MotionReader, body_names: tuple[str, ...] | None) -> slice | torch.Tensor:
    """Return which of the tracked bodies are meant, in the command's order; None means all.

    Raises:
        ValueError: a name is none of the tracked bodies, or there is none.
    """
    if body_names is None:
        return slice(None)
    tracked = command.body_names if isinstance(command, MotionReader) else command.cfg.body_names
    device = str(command.body_pos_relative_w.device)
    return _columns_of(tuple(body_names), tuple(tracked), device)


@functools.lru_cache(maxsize=256)
def _columns_of(body_names: tuple[str, ...], tracked: tuple[str, ...], device: str) -> torch.Tensor:
    unknown = [name for name in body_names if name not in tracked]
    if unknown or not body_names:
        what = f"{unknown}, which are not tracked" if unknown else "no body"
        raise ValueError(f"body_names names {what}. The command tracks {list(tracked)}.")
    columns = [i for i, name in enumerate(tracked) if name in body_names]
    return torch.tensor(columns, device=device)
