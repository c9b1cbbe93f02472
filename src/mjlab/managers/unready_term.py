"""Stand-in for a term that is off and could not be built."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class UnreadyTerm:
    """Is called instead of a term that is off and does not fit, and tries to build it again then.

    A term that is off may be left unfilled: what does not fit matters only when it is switched on.

    Args:
        build: Builds the term and returns what to call from then on, or raises what was wrong.
    """

    def __init__(self, build: Callable[[], Any]) -> None:
        self._build = build

    def __call__(self, env: Any, **params: Any) -> Any:
        """Build the term, and return its value."""
        return self._build()(env, **params)
