"""Bad term values, such as NaN: counted, reported once per term, left out of means."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from mjlab.utils.string import counted

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

logger = logging.getLogger(__name__)


class BadValueWatch:
    """Counts bad term values, such as NaN, without synchronizing with the GPU.

    On a CPU, they are logged at once. On a GPU, only `report` logs; training calls it each iteration.

    Args:
        labels: Name of each term in messages.
        fault: Description of bad values in messages, e.g. "NaN or infinite".
        outcome: Effect of bad values in messages, e.g. "counts as 0".
        env: The environment. Values where its physics diverged are not counted.

    Attributes:
        fault: Description of bad values in messages.
        count: Number of bad values in the last step, () int64.
    """

    def __init__(
        self, labels: Sequence[str], fault: str, outcome: str, env: ManagerBasedRlEnv
    ) -> None:
        self._labels, self.fault, self._outcome = labels, fault, outcome
        self._env, terms, device = env, len(labels), env.device
        self._on_cpu = torch.device(device).type == "cpu"
        self.count = self._none = torch.zeros((), dtype=torch.long, device=device)
        # Consecutive steps with a bad value in every environment, by term.
        self._streaks = torch.zeros(terms, dtype=torch.long, device=device)
        self._first_steps = torch.full((terms,), -1, dtype=torch.long, device=device)
        self._first_counts = torch.zeros(terms, dtype=torch.long, device=device)
        self._named: set[int] = set()

    def check(self, values: torch.Tensor, step: int) -> torch.Tensor | None:
        """Record NaN and infinite values, (terms, N), and return their mask.

        On a CPU, None if all values are finite.
        """
        # A finite sum proves that all values are finite.
        if self._on_cpu and math.isfinite(values.sum().item()):
            # Not in place: the tensor may have been created in inference mode.
            self._streaks = torch.zeros_like(self._streaks)
            self.count = self._none
            return None
        bad = ~torch.isfinite(values)
        self.record(bad, step)
        return bad

    def record(self, bad: torch.Tensor, step: int) -> None:
        """Count the bad values of environment step `step`, given as a mask (terms, N)."""
        diverged = self._env.diverged
        counts = (bad & ~diverged).sum(dim=1)
        found = counts > 0
        everywhere = found & (bad | diverged).all(dim=1)
        self._streaks = (self._streaks + 1) * everywhere
        is_first = found & (self._first_steps < 0)
        self._first_steps = torch.where(is_first, step, self._first_steps)
        self._first_counts = torch.where(is_first, counts, self._first_counts)
        self.count = counts.sum()
        if self._on_cpu:
            self.report()

    def report(self) -> None:
        """Log each term with a bad value, once per term."""
        for k, step in enumerate(self._first_steps.tolist()):
            if step < 0 or k in self._named:
                continue
            self._named.add(k)
            logger.warning(
                "%s was %s in %d of %s in step %d and %s; not logged again.",
                self._labels[k], self.fault, int(self._first_counts[k]),
                counted(self._env.num_envs, "environment"), step, self._outcome,
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
