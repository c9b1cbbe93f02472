"""How long something has been touching, or not: the clocks of feet."""

from __future__ import annotations

import torch

from mjlab.utils.state import stateful


@stateful
class ContactClocks:
    """Durations of the running and of the last completed phases, of contact and of air.

    Time is kept in double precision, because single precision rounds every increment: the clock of
    a foot that has stood for an hour would be off by seconds, and at the end of a day it stands
    still.
    """

    _transient = {"_running", "_last", "_idle", "_ended", "_contact_is_idle", "_zero"}

    def __init__(self, num_envs: int, num_things: int, device: str) -> None:
        """Start `num_things` things in each environment in no phase: all durations are zero."""
        shape = (num_envs, num_things)
        self._times = torch.zeros(4, *shape, dtype=torch.float64, device=device)
        self._running, self._last = self._times[:2], self._times[2:]
        # Scratch: which of air and contact does not run now, and which of them has just ended.
        self._idle = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        self._ended = torch.zeros(2, *shape, dtype=torch.bool, device=device)
        # Air is idle in contact (True), contact is idle in the air (False).
        self._contact_is_idle = torch.tensor([False, True], device=device).view(2, 1, 1)
        self._zero = torch.zeros((), dtype=torch.float64, device=device)

    def update(self, in_contact: torch.Tensor, dt: float) -> None:
        """Advance by a substep of `dt` seconds, after which `in_contact` (N, P) bool are touching.

        The substep in which a phase ends counts as part of it, and as the first one of the next: n
        substeps in the air are reported as (n + 1) dt.
        """
        torch.ne(in_contact, self._contact_is_idle, out=self._idle)
        torch.gt(self._running, 0.0, out=self._ended)
        self._ended.logical_and_(self._idle)
        self._running.add_(dt)
        torch.where(self._ended, self._running, self._last, out=self._last)
        # Faster than `masked_fill_`.
        torch.where(self._idle, self._zero, self._running, out=self._running)

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all durations of some environments to zero."""
        self._times[:, rows] = 0.0

    @property
    def air(self) -> torch.Tensor:
        """(N, P) float64 duration of the running phase of air, s; 0 in contact."""
        return self._times[0]

    @property
    def contact(self) -> torch.Tensor:
        """(N, P) float64 duration of the running phase of contact, s; 0 in the air."""
        return self._times[1]

    def in_single_precision(self) -> tuple[torch.Tensor, ...]:
        """Return running air, running contact, last air, last contact, each (N, P) float32, s."""
        return self._times.float().unbind()
