"""Recent values of named terms, one point for every environment step."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np


class TermHistory:
    """Keeps the last `length` values of each term of a manager, for one environment."""

    def __init__(self, length: int):
        self.length = length
        self._values: dict[str, deque[float]] = {}

    @property
    def names(self) -> list[str]:
        return list(self._values)

    def add(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Append one point a term, as `get_active_iterable_terms(env_idx)` gives them.

        A value that is not finite is recorded as NaN, which plots leave out.
        """
        for name, values in terms:
            value = float(np.ravel(values)[0])
            series = self._values.setdefault(name, deque(maxlen=self.length))
            series.append(value if np.isfinite(value) else float("nan"))

    def values(self, name: str) -> np.ndarray:
        """Points of one term, (count,), the latest last."""
        return np.array(self._values.get(name, ()), dtype=float)

    def mean(self, name: str) -> float:
        """Mean of the finite points; 0 without any."""
        values = self.values(name)
        finite = values[np.isfinite(values)]
        return float(finite.mean()) if len(finite) else 0.0

    def clear(self) -> None:
        """Forget the points, keep the names."""
        for series in self._values.values():
            series.clear()
