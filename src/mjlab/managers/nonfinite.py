"""Values of terms that are NaN or infinite: counted, named once, left out of means."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import torch

logger = logging.getLogger(__name__)


class NonFiniteWatch:
    """Counts values of terms that are NaN or infinite, without waiting for a GPU.

    Args:
        labels: Name of each term, as messages have it.
        fault: What is wrong with such a value, and `counted_as` what it counts as, for messages.
        num_envs: Number of environments N.
        device: Device of the values.

    Attributes:
        fault: As given.
        excluded: (N,) bool, environments in which no term is to blame: the physics diverged.
        count: Number of such values in the last step, () int64.
    """

    def __init__(
        self, labels: Sequence[str], fault: str, counted_as: str, num_envs: int, device: str
    ) -> None:
        self._labels, self.fault, self._counted_as = labels, fault, counted_as
        self._on_cpu = torch.device(device).type == "cpu"
        self.excluded = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.count = torch.zeros((), dtype=torch.long, device=device)
        self._none = self.count
        self._step = 0
        terms = len(labels)
        # Steps in a row in which every environment had such a value, for each term.
        self._streaks = torch.zeros(terms, dtype=torch.long, device=device)
        self._first_steps = torch.full((terms,), -1, dtype=torch.long, device=device)
        self._first_counts = torch.zeros(terms, dtype=torch.long, device=device)
        self._named: set[int] = set()

    def begin_step(self, excluded: torch.Tensor, step: int) -> None:
        """Set `excluded`, and the number of the step for messages."""
        self.excluded, self._step, self.count = excluded, step, self._none

    def look(self, values: torch.Tensor) -> torch.Tensor | None:
        """Return where values (terms, N) of a step are NaN or infinite; on a CPU, None if nowhere."""
        # One number tells for nearly every step that all is well.
        if self._on_cpu and math.isfinite(values.sum().item()):
            # Not in place: it may have been made in inference mode.
            self._streaks = torch.zeros_like(self._streaks)
            return None
        bad = ~torch.isfinite(values)
        told = bad & ~self.excluded
        counts = told.sum(dim=1)
        found = counts > 0
        everywhere = found & (bad | self.excluded).all(dim=1)
        self._streaks = (self._streaks + 1) * everywhere
        is_first = found & (self._first_steps < 0)
        self._first_steps = torch.where(is_first, self._step, self._first_steps)
        self._first_counts = torch.where(is_first, counts, self._first_counts)
        self.count = counts.sum()
        if self._on_cpu:
            self.report()
        return bad

    def report(self) -> None:
        """Log each term that had such a value for the first time."""
        for k, step in enumerate(self._first_steps.tolist()):
            if step < 0 or k in self._named:
                continue
            self._named.add(k)
            logger.warning(
                "%s was %s in %d of %d environments in step %d, which counts as %s. It is not logged again.",
                self._labels[k], self.fault, int(self._first_counts[k]), len(self.excluded), step,
                self._counted_as,
            )  # fmt: skip

    def streaks(self) -> dict[str, int]:
        """Return the terms that were NaN or infinite in every environment, by label, with the number
        of steps in a row up to now."""
        streaks = zip(self._labels, self._streaks.tolist(), strict=True)
        return {label: steps for label, steps in streaks if steps > 0}


def finite_mean(values: torch.Tensor) -> torch.Tensor:
    """Return the mean over the last axis, leaving out NaN and infinite values; 0 if none is left.

    Args:
        values: Float tensor (..., E) with one value for each of E environments.
    """
    # `isfinite` takes twice the operations.
    finite = values.abs() < torch.inf
    return torch.where(finite, values, 0.0).sum(dim=-1) / finite.sum(dim=-1).clamp(min=1)
