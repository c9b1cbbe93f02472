"""Marks for work whose effect is the same at every physics substep of one environment step.

An environment step runs `decimation` physics substeps. Where nothing has to act between them, the
engine runs all of them in one dispatch, which is where a CPU run gets its speed. A method is only
trusted to be constant when its author says so: a subclass that overrides it loses the mark.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_MARK = "_constant_within_step"


def constant_within_step(function: F) -> F:
    """Mark `function` as having the same effect at every substep of an environment step."""
    setattr(function, _MARK, True)
    return function


def is_constant_within_step(function: Callable[..., Any]) -> bool:
    """Return whether `function` (plain or bound) carries the mark of `constant_within_step`."""
    return bool(getattr(function, _MARK, False))
