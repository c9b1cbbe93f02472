"""Saying which term an error comes from."""

from __future__ import annotations

import contextlib
from collections.abc import Generator


@contextlib.contextmanager
def errors_named(label: str) -> Generator[None]:
    """Put `label` in front of the message of a `KeyError`, `TypeError` or `ValueError` of the block.

    What a term raises while it is built knows its cause, but not which of many terms it is. The
    type of the error stays, unless it cannot be made from a message alone; it then becomes the
    `KeyError`, `TypeError` or `ValueError` that it is derived from.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError) as error:
        raise _relabelled(error, label) from error


def _relabelled(error: KeyError | TypeError | ValueError, label: str) -> Exception:
    # A KeyError shows its message as a quoted string, so that it is read from its arguments.
    details = error.args[0] if len(error.args) == 1 else error
    message = f"{label}: {details}"
    try:
        return type(error)(message)
    except TypeError:
        kind = next(k for k in (KeyError, TypeError, ValueError) if isinstance(error, k))
        return kind(message)
