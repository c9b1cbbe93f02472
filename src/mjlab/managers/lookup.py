"""Look-ups of the environments in a mask, several at once on a GPU.

`mask.nonzero()` makes the host wait until the GPU has done all that is queued. So `env.step` plans
the look-ups that it and the managers will need, before they are needed, and `look_up` waits once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


class Lookup:
    """Ids of the environments in a mask, found before they are needed.

    The mask is a function of inputs, such as a timer and the time that passes. `take` returns its
    ids only while the inputs are unchanged: equal numbers, and the same tensors, to which PyTorch
    has counted no write since. So terms may do anything between planning and use. (Writes through
    `tensor.data`, and by kernels of other libraries, are not counted.)

    Attributes:
        mask: (N,) bool, the planned mask.
        ids: (n,) int64, what `look_up` found; None before.
    """

    mask: torch.Tensor

    def __init__(self) -> None:
        self.ids: torch.Tensor | None = None
        # The tensors are kept, so that none has the id of one that is gone.
        self._inputs: tuple[torch.Tensor | float, ...] = ()
        self._stamps: list[Any] = []

    def plan(self, mask: torch.Tensor, *inputs: torch.Tensor | float) -> Lookup:
        """Prepare for `look_up` of `mask`, (N,) bool, a function of `inputs`; return self."""
        self.mask, self.ids = mask, None
        self._inputs, self._stamps = inputs, [_stamp(value) for value in inputs]
        return self

    def take(self, *inputs: torch.Tensor | float) -> torch.Tensor | None:
        """Return the ids; None if they were not looked up, or these are not the same inputs."""
        if self.ids is None or self._stamps != [_stamp(value) for value in inputs]:
            return None
        return self.ids


def look_up(lookups: Sequence[Lookup]) -> None:
    """Find the ids of planned look-ups, waiting for the GPU once. All masks are on a GPU."""
    if not lookups:
        return
    masks = torch.stack([lookup.mask for lookup in lookups])
    for lookup, mask in zip(lookups, masks.cpu(), strict=True):
        # Copies from pinned memory do not wait.
        ids = mask.nonzero().flatten().pin_memory()
        lookup.ids = ids.to(masks.device, non_blocking=True)


def _stamp(value: torch.Tensor | float) -> Any:
    if not isinstance(value, torch.Tensor):
        return value
    # Writes to inference tensors are not counted, so that they are never the same.
    return (id(value), object() if value.is_inference() else value._version)
