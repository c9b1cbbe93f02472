"""Errors that a user can fix, and the checks that raise them.

    MjlabError                 base; commands print the message without a traceback
    ├── UserError              in what a command was asked to do
    │   └── BadCallError       in the command line itself; nothing was started
    ├── UnknownNameError       no such entity, sensor, term, ...   (a KeyError)
    ├── UnknownAttributeError  no such attribute                   (an AttributeError)
    ├── WrongTypeError         value or class of the wrong type    (a TypeError)
    ├── WrongStateError        called too early, too late or twice (a RuntimeError)
    └── UnsupportedError       engine, model or setting unsupported (a NotImplementedError)

A wrong value of an argument or field is a plain `ValueError`, which commands print the same way.
Messages read "<owner> <field>: expected X, got Y; use Z."
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Generator, Iterable
from numbers import Integral
from typing import Any

from mjlab.utils.string import suggest


class MjlabError(Exception):
    """Base of errors that a user can fix."""

    exit_status = 1
    """Exit status of a command that ends with this error."""


class UserError(MjlabError):
    """Error in what a command was asked to do."""


class BadCallError(UserError):
    """Error in the command line itself, found before anything is built."""

    exit_status = 2


class UnknownNameError(MjlabError, KeyError):
    """Name that is not defined."""

    def __str__(self) -> str:
        # KeyError would show the repr of the message.
        return str(self.args[0]) if self.args else ""


class UnknownAttributeError(MjlabError, AttributeError):
    """Attribute that the object does not have."""


class WrongTypeError(MjlabError, TypeError):
    """Value or class of the wrong type."""


class WrongStateError(MjlabError, RuntimeError):
    """Call that the object's state does not allow."""


class UnsupportedError(MjlabError, NotImplementedError):
    """Request that the engine, the model or a setting does not support."""


@contextlib.contextmanager
def warned() -> Generator[None]:
    """Turn a `ValueError` of the block into a `UserWarning`: of values that releases 1.x accept."""
    try:
        yield
    except ValueError as error:
        # The frames of this function and of `contextlib` are not of interest.
        warnings.warn(str(error), UserWarning, stacklevel=3)


def check_positive(name: str, value: float) -> None:
    """Raise `ValueError` unless `value` > 0. NaN is rejected."""
    if not value > 0:
        raise ValueError(f"{name}: expected a number > 0, got {value}.")


def check_count(name: str, value: Any, minimum: int = 1) -> None:
    """Raise `ValueError` unless `value` is an integer >= `minimum`. True is 1."""
    if not isinstance(value, Integral) or value < minimum:
        raise ValueError(f"{name}: expected an integer >= {minimum}, got {value!r}.")


def check_in_range(name: str, value: float, low: float, high: float) -> None:
    """Raise `ValueError` unless `low` <= `value` <= `high`. NaN is rejected."""
    if not low <= value <= high:
        raise ValueError(f"{name}: expected a number in [{low}, {high}], got {value}.")


def check_one_of(name: str, value: Any, allowed: Iterable[Any]) -> None:
    """Raise `ValueError` unless `value` is in `allowed`."""
    options = list(allowed)
    if value not in options:
        raise ValueError(f"{name}: expected one of {options}, got {value!r}.")


def check_field(cfg: Any, field: str, holds: bool, expected: str) -> None:
    """Raise `ValueError` "<class>.<field>: expected <expected>, got <value>." unless `holds`."""
    if not holds:
        raise ValueError(
            f"{type(cfg).__name__}.{field}: expected {expected}, got {getattr(cfg, field)!r}."
        )


def check_fields_positive(cfg: Any, *fields: str) -> None:
    """Raise `ValueError` for the first of the fields that is not a finite number > 0."""
    for field in fields:
        check_field(cfg, field, 0.0 < getattr(cfg, field) < math.inf, "a finite number > 0")


def check_exists(
    kind: str, name: str, available: Iterable[str], error: type[Exception] = ValueError
) -> None:
    """Raise `error` unless `name` is in `available`; the message suggests close names."""
    names = list(available)
    if name not in names:
        raise error(f"Unknown {kind} {name!r}; {suggest(name, names)}")
