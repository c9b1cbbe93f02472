"""Making the very first step of an environment like every later one.

Between a step and the next `forward`, derived fields are one substep old. A field costs nothing
before somebody reads it, and terms read most fields for the first time in the middle of the first
step: then they have to be computed from the state before the last substep, which is gone. So that
state is kept, but only until the first `forward` after a step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjlab.sim.engines.field_lists import INPUTS

# More substeps than a step has: who goes on without `forward` runs no environment, and should not
# pay for what is kept.
_MOST_DISPATCHES = 100


class FirstStep:
    """Keeps the state before the last substep, and takes that substep once more when asked to."""

    def __init__(self, batch: Any, arrays: dict[str, np.ndarray]) -> None:
        """Look after `batch` (an `mjbatch.Batch`), whose bound fields are `arrays`, by name."""
        self._batch, self._arrays = batch, arrays
        self._dispatches_left = _MOST_DISPATCHES
        self._before: np.ndarray | None = None
        # What the bound inputs held after the substep: where they differ, a write is pending.
        self._inputs: dict[str, np.ndarray] = {}

    @property
    def is_over(self) -> bool:
        """Whether steps need not be taken by `step` any more."""
        return self._dispatches_left == 0

    @property
    def can_repeat(self) -> bool:
        """Whether `repeat_substep` has a substep to take again."""
        return self._before is not None

    def step(self, nstep: int, consume_writes: Callable[[], None]) -> None:
        """Step, and keep the state before the last substep, with all that was written before."""
        self._dispatches_left -= 1
        if nstep > 1:
            self._batch.step(nstep=nstep - 1)
        else:
            consume_writes()
        self._before = None if self.is_over else self._batch.bind("state").copy()
        self._batch.step(nstep=1)
        self._inputs = {name: self._arrays[name].copy() for name in self._arrays.keys() & INPUTS}

    def input_was_bound(self, name: str) -> None:
        """Take note of an input that was just bound and not yet written."""
        if self.can_repeat:
            self._inputs[name] = self._arrays[name].copy()

    def repeat_substep(self) -> None:
        """Fill derived fields by the last substep; state and pending writes stay as they are."""
        rows = self._batch.bind("state")
        after = rows.copy()
        pending = {name: self._arrays[name].copy() for name in self._inputs}
        for name, values in self._inputs.items():
            self._arrays[name][:] = values
        rows[:] = self._before
        self._batch.step(nstep=1)
        rows[:] = after
        for name, values in pending.items():
            self._arrays[name][:] = values

    def forget(self) -> None:
        """Drop what was kept, because something else was done to the simulations."""
        self._before, self._inputs = None, {}

    def forward(self) -> None:
        """Drop what was kept, and keep nothing more once a step was followed by `forward`."""
        if self.can_repeat:
            self._dispatches_left = 0
        self.forget()
