"""Checks that a term which is a function brings along, for the manager to make when it is built.

A class has its constructor for this. A function would notice a sensor that does not exist only at
the first step, and columns in another order never.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

F = TypeVar("F", bound=Callable[..., Any])

_ATTRIBUTE = "check_when_built"


def checked_when_built(check: Callable[..., None]) -> Callable[[F], F]:
    """Decorator of term functions: `check(env, **params)` is called when a manager is built.

    `check` gets the parameters of the term's config, selections resolved, and raises `ValueError`,
    `KeyError` or `TypeError` if the term could not work with them. It should take `**_` for those
    that it does not look at.
    """

    def mark(function: F) -> F:
        setattr(function, _ATTRIBUTE, check)
        return function

    return mark


def check_term(function: Any, env: ManagerBasedRlEnv, params: dict[str, Any]) -> None:
    """Make the check of a term's function, if it brings one."""
    check = getattr(function, _ATTRIBUTE, None)
    if check is not None:
        check(env, **params)
