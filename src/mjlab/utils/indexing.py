"""TODO."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mjlab.envs import ManagerBasedRlEnv


# MERGED mjlab.utils.indexing: The ways to name environments: None (all), a slice, a bool mask or a 1-D integer tensor.

EnvIds = torch.Tensor | slice | None


def as_index(env_ids: EnvIds) -> torch.Tensor | slice:
    """Return what tensors with a leading environment dimension can be indexed by."""
    return slice(None) if env_ids is None else env_ids


def as_ids(env_ids: EnvIds, num_envs: int, device: str) -> torch.Tensor:
    """Return the environment indices as a 1-D int64 tensor, which terms may rely on."""
    if env_ids is None or isinstance(env_ids, slice):
        return torch.arange(num_envs, device=device)[as_index(env_ids)]
    if env_ids.dtype == torch.bool:
        return env_ids.nonzero().flatten()
    return env_ids.long()


def is_empty(env_ids: EnvIds) -> bool:
    """Return whether no environment is named (without looking at what a bool mask holds)."""
    return isinstance(env_ids, torch.Tensor) and env_ids.numel() == 0


# MERGED mjlab.utils.indexing: Reading and writing columns of batched tensors, by slice wherever the columns are neighbours.

Columns = slice | torch.Tensor


def as_columns(ids: Sequence[int], device: str) -> Columns:
    """Return `ids` as a slice if each is one more than the last, else as an int64 tensor.

    A slice costs no gather: reading with it makes a view, writing with it is one plain copy.
    """
    first = ids[0] if ids else 0
    if list(ids) == list(range(first, first + len(ids))):
        return slice(first, first + len(ids))
    return torch.tensor(list(ids), dtype=torch.int64, device=device)


def read_columns(source: torch.Tensor, columns: Columns) -> torch.Tensor:
    """Return columns of `source` (N, m): a view if `columns` is a slice, else a copy."""
    return source[:, columns] if isinstance(columns, slice) else source.index_select(1, columns)


def write_columns(
    target: torch.Tensor, columns: Columns, values: torch.Tensor, env_ids: EnvIds = None
) -> None:
    """Write `values` (N, n) into columns of `target` (N, m), in all rows or in `env_ids`."""
    if isinstance(columns, slice):
        if env_ids is None:
            target[:, columns] = values
        else:
            target[env_ids, columns] = values[env_ids]
    elif env_ids is None:
        target.index_copy_(1, columns, values)
    else:
        rows = as_rows(env_ids, target.shape[0], target.device)
        target[rows[:, None], columns] = values[rows]


def as_rows(env_ids: EnvIds, num_envs: int, device: torch.device | str) -> torch.Tensor:
    """Return environment ids, given in any of the usual forms, as an int64 tensor."""
    if isinstance(env_ids, torch.Tensor) and env_ids.dtype != torch.bool:
        return env_ids.to(device=device, dtype=torch.int64)
    every = torch.arange(num_envs, device=device)
    return every if env_ids is None else every[env_ids]


# MERGED mjlab.utils.indexing: Turning ids as configs hold them into what tensors are indexed with.


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
