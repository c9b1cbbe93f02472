"""Terminal output."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Generator

from mjlab.utils.errors import check_one_of

logger = logging.getLogger(__name__)

_CODES = {
    "red": 31,
    "green": 32,
    "yellow": 33,
    "blue": 34,
    "magenta": 35,
    "cyan": 36,
    "white": 37,
}

_LONGEST = 8000
_MOST_LINES = 100


def print_info(message: str, color: str = "green") -> None:
    """Print a message, colored if the output is a terminal. For commands, not libraries.

    Raises `ValueError` for an unknown color.
    """
    check_one_of("color", color, _CODES)
    if sys.stdout.isatty():
        message = f"\033[{_CODES[color]}m{message}\033[0m"
    print(message)


def print_notice(message: str) -> None:
    """Print a notice to stderr. Stdout is reserved for a command's results."""
    print(shorten(message), file=sys.stderr, flush=True)


def print_list(title: str, lines: list[str]) -> None:
    """Print a list to stderr, shortened if long; nothing if empty."""
    if lines:
        more = len(lines) - _MOST_LINES
        shown = [*lines[:_MOST_LINES], *([f"and {more} more"] if more > 0 else [])]
        print_notice("\n    ".join([title, *shown]))


@contextlib.contextmanager
def beside_results(name: str) -> Generator[None]:
    """Turn an error within the block into a warning. The block writes `name` beside saved results."""
    try:
        yield
    except Exception as error:
        logger.warning(
            "Not written: %s: %s", name, shorten(str(error).strip() or type(error).__name__)
        )


def first_line(error: BaseException, longest: int = 160) -> str:
    """Return the first line of an error's message, or its type if it has none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:longest]


def shorten(text: str) -> str:
    """Return `text`, shortened to both ends if longer than 8,000 characters (e.g. a damaged file)."""
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]} [...] {text[-half:]}"
