"""What a contact sensor measured at the last few physics substeps."""

from __future__ import annotations

import torch

from mjlab.utils.state import stateful


@stateful
class ContactHistory:
    """A ring of raw blocks of sensor data, zero before anything was recorded.

    Blocks are kept as they come, and are taken apart only when somebody reads them: recording has
    to be cheap, because it happens at every substep.
    """

    _transient = {"_slots", "_orders"}

    def __init__(self, length: int, num_envs: int, width: int, device: str) -> None:
        """Make room for `length` blocks of shape (num_envs, width)."""
        # `_head` is the newest block; older ones follow it cyclically.
        self._ring = torch.zeros(length, num_envs, width, dtype=torch.float32, device=device)
        self._head = 0
        self._slots = list(self._ring.unbind())
        slots = torch.arange(length, device=device)
        self._orders = [slots.roll(-head) for head in range(length)]

    def record(self, block: torch.Tensor) -> None:
        """Add a block (N, width), in the place of the oldest one."""
        self._head = (self._head - 1) % len(self._slots)
        self._slots[self._head].copy_(block)

    def newest_first(self) -> torch.Tensor:
        """Return a copy of the blocks, (length, N, width)."""
        return self._ring.index_select(0, self._orders[self._head])

    def reset(self, rows: torch.Tensor | slice) -> None:
        """Set all blocks of some environments to zero."""
        self._ring[:, rows] = 0.0
