"""Settings of learners that change during training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Schedule:
    """Setting given by points (step or iteration, value), interpolated linearly; constant outside them."""

    def __init__(self, name: str, points: Sequence[tuple[int, float]]) -> None:
        """Take the points; `name` is that of the setting, for the error.

        Raises:
            ValueError: there is no point, or their steps do not increase.
        """
        steps = [step for step, _ in points]
        if not steps or steps != sorted(set(steps)):
            raise ValueError(f"{name}: expected points with increasing steps, got {points!r}.")
        self._steps, self._values = zip(*points, strict=True)

    def at(self, step: int) -> float:
        """Return the value at `step`."""
        return float(np.interp(step, self._steps, self._values))
