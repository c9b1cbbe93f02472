"""Turning ids as configs hold them into what tensors are indexed with."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch

from mjlab.managers.env_ids import as_ids

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mjlab.envs import ManagerBasedRlEnv


def resolve_env_ids(env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice | None) -> torch.Tensor:
    """Return environment ids as an int64 tensor.

    Args:
        env_ids: None (all environments), int ids, a bool mask or a slice.
    """
    return as_ids(env_ids, env.num_envs, env.device)


def columns(ids: Sequence[int] | torch.Tensor | slice | int, device: str) -> slice | torch.Tensor:
    """Return what selects `ids` along the second dimension, as a slice wherever one exists.

    A slice gives a view where a list of ids gives a copy, which matters for terms that run at
    every step for thousands of environments.
    """
    if isinstance(ids, (slice, torch.Tensor)):
        return ids
    return _columns_of((ids,) if isinstance(ids, int) else tuple(ids), device)


@functools.lru_cache(maxsize=4096)
def _columns_of(ids: tuple[int, ...], device: str) -> slice | torch.Tensor:
    is_run = len(ids) > 0 and ids[0] >= 0 and ids == tuple(range(ids[0], ids[0] + len(ids)))
    if is_run:
        return slice(ids[0], ids[0] + len(ids))
    return torch.tensor(ids, dtype=torch.long, device=device)


def num_selected(ids: Sequence[int] | torch.Tensor | slice | int, count: int) -> int:
    """Return how many of `count` objects `ids` selects."""
    if isinstance(ids, slice):
        return len(range(count)[ids])
    return 1 if isinstance(ids, int) else len(ids)
