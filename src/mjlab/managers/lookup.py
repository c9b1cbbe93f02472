"""Batched lookup of environment ids from masks on a GPU.

`mask.nonzero()` synchronizes with the GPU. `env.step` therefore plans its lookups and those of the
managers in advance, and `look_up` synchronizes once for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


class Lookup:
    """Environment ids of a mask, computed ahead of use.

    The mask is a function of inputs, such as a timer and a time step. `take` returns the ids only
    while the inputs are unchanged: equal numbers, and the same tensors at the same PyTorch version
    counter. Terms may therefore do anything between planning and use. (The counter misses writes
    through `tensor.data` and by kernels of other libraries.)

    Attributes:
        mask: Planned mask, (N,) bool.
        ids: Ids found by `look_up`, (n,) int64; None before.
    """

    mask: torch.Tensor

    def __init__(self) -> None:
        self.ids: torch.Tensor | None = None
        # References keep the tensors alive: Python reuses the `id` of a freed object.
        self._inputs: tuple[torch.Tensor | float, ...] = ()
        self._stamps: list[Any] = []

    def plan(self, mask: torch.Tensor, *inputs: torch.Tensor | float) -> Lookup:
        """Plan the lookup of `mask`, (N,) bool, a function of `inputs`; return self."""
        self.mask, self.ids = mask, None
        self._inputs, self._stamps = inputs, [_stamp(value) for value in inputs]
        return self

    def take(self, *inputs: torch.Tensor | float) -> torch.Tensor | None:
        """Return the ids; None if they were not looked up or the inputs changed."""
        if self.ids is None or self._stamps != [_stamp(value) for value in inputs]:
            return None
        return self.ids

    def ids_of(self, mask: torch.Tensor) -> torch.Tensor:
        """Return the ids of `mask`, its only input: those looked up, else by `nonzero`."""
        ids = self.take(mask)
        return mask.nonzero().flatten() if ids is None else ids


def look_up(lookups: Sequence[Lookup]) -> None:
    """Find the ids of planned lookups with one GPU synchronization. All masks are on a GPU."""
    if not lookups:
        return
    masks = torch.stack([lookup.mask for lookup in lookups])
    for lookup, mask in zip(lookups, masks.cpu(), strict=True):
        # Copies from pinned memory do not synchronize.
        ids = mask.nonzero().flatten().pin_memory()
        lookup.ids = ids.to(masks.device, non_blocking=True)


def _stamp(value: torch.Tensor | float) -> Any:
    if not isinstance(value, torch.Tensor):
        return value
    # Inference tensors have no version counter; a new object makes them always differ.
    return (id(value), object() if value.is_inference() else value._version)
