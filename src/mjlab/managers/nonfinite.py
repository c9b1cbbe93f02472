"""NaN and infinite term values: counted, logged once per term, left out of means."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import torch

from mjlab.utils.string import counted

logger = logging.getLogger(__name__)


class NonFiniteWatch:
    """Counts NaN and infinite term values without synchronizing with the GPU.

    Args:
        labels: Name of each term in messages.
        fault: Description of bad values in messages, e.g. "NaN or infinite".
        outcome: Effect of bad values in messages, e.g. "counts as 0".
        num_envs: Number of environments N.
        device: Device of the values.

    Attributes:
        fault: Description of bad values in messages.
        excluded: Environments whose bad values are not counted, because the physics diverged,
            (N,) bool.
        count: Number of bad values in the last step, () int64.
    """

    def __init__(
        self, labels: Sequence[str], fault: str, outcome: str, num_envs: int, device: str
    ) -> None:
        self._labels, self.fault, self._outcome = labels, fault, outcome
        self._on_cpu = torch.device(device).type == "cpu"
        self.excluded = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.count = torch.zeros((), dtype=torch.long, device=device)
        self._none = self.count
        self._step = 0
        terms = len(labels)
        # Consecutive steps with a bad value in every environment, by term.
        self._streaks = torch.zeros(terms, dtype=torch.long, device=device)
        self._first_steps = torch.full((terms,), -1, dtype=torch.long, device=device)
        self._first_counts = torch.zeros(terms, dtype=torch.long, device=device)
        self._named: set[int] = set()

    def begin_step(self, excluded: torch.Tensor, step: int) -> None:
        """Set `excluded`, and the step number for messages."""
        self.excluded, self._step, self.count = excluded, step, self._none

    def check(self, values: torch.Tensor) -> torch.Tensor | None:
        """Return a mask of NaN and infinite values of a step, (terms, N).

        On a CPU, None if all values are finite.
        """
        # A finite sum proves that all values are finite.
        if self._on_cpu and math.isfinite(values.sum().item()):
            # Not in place: the tensor may have been created in inference mode.
            self._streaks = torch.zeros_like(self._streaks)
            return None
        bad = ~torch.isfinite(values)
        counted = bad & ~self.excluded
        counts = counted.sum(dim=1)
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
        """Log each term with a bad value, once per term."""
        for k, step in enumerate(self._first_steps.tolist()):
            if step < 0 or k in self._named:
                continue
            self._named.add(k)
            logger.warning(
                "%s was %s in %d of %s in step %d and %s; not logged again.",
                self._labels[k], self.fault, int(self._first_counts[k]),
                counted(len(self.excluded), "environment"), step, self._outcome,
            )  # fmt: skip

    def streaks(self) -> dict[str, int]:
        """Return the number of consecutive steps with a bad value in every environment, by label.

        Terms without such a streak are left out.
        """
        streaks = zip(self._labels, self._streaks.tolist(), strict=True)
        return {label: steps for label, steps in streaks if steps > 0}


def finite_mean(values: torch.Tensor) -> torch.Tensor:
    """Return the mean of the finite values over the last axis; 0 if no value is finite.

    Args:
        values: Values of E environments, float (..., E).
    """
    # `isfinite` takes twice as many operations.
    finite = values.abs() < torch.inf
    return torch.where(finite, values, 0.0).sum(dim=-1) / finite.sum(dim=-1).clamp(min=1)
