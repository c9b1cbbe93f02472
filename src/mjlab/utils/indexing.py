"""Row and column indices of batched tensors: environment ids and element ids."""

from __future__ import annotations

from collections.abc import Sequence

import torch

EnvIds = torch.Tensor | slice | None
"""Environments: None (all), a slice, a bool mask or 1-D integer ids."""

Columns = slice | torch.Tensor
"""Column index of a tensor: a slice, or int64 ids."""


def as_ids(
    env_ids: EnvIds | Sequence[int], num_envs: int, device: torch.device | str
) -> torch.Tensor:
    """Return environment ids as a 1-D int64 tensor on `device`."""
    if env_ids is None:
        return torch.arange(num_envs, device=device)
    if not isinstance(env_ids, slice):
        env_ids = torch.as_tensor(env_ids, device=device)
        if env_ids.dtype != torch.bool:
            return env_ids.long().flatten()
    return torch.arange(num_envs, device=device)[env_ids]


def as_index(env_ids: EnvIds) -> torch.Tensor | slice:
    """Return environment ids as the first index of a tensor."""
    return slice(None) if env_ids is None else env_ids


def is_empty(env_ids: EnvIds) -> bool:
    """Return True for an empty tensor. Bool masks are not read, to avoid a GPU synchronization."""
    return isinstance(env_ids, torch.Tensor) and env_ids.numel() == 0


def as_columns(
    ids: Sequence[int] | torch.Tensor | slice | int, device: torch.device | str
) -> Columns:
    """Return contiguous `ids` as a slice, other ids as an int64 tensor.

    Slices and tensors are returned unchanged. Slices avoid a gather: reads are views, writes are
    plain copies.
    """
    if isinstance(ids, (slice, torch.Tensor)):
        return ids
    ids = (ids,) if isinstance(ids, int) else tuple(ids)
    first = ids[0] if ids else 0
    if first >= 0 and ids == tuple(range(first, first + len(ids))):
        return slice(first, first + len(ids))
    return torch.tensor(ids, dtype=torch.int64, device=device)


def num_selected(ids: Sequence[int] | torch.Tensor | slice | int, count: int) -> int:
    """Return the number of elements, out of `count`, that `ids` selects."""
    if isinstance(ids, slice):
        return len(range(count)[ids])
    return 1 if isinstance(ids, int) else len(ids)


def read_columns(source: torch.Tensor, columns: Columns) -> torch.Tensor:
    """Return columns of `source`, (N, m): a view if `columns` is a slice, else a copy."""
    return source[:, columns] if isinstance(columns, slice) else source.index_select(1, columns)


def write_columns(
    target: torch.Tensor, columns: Columns, values: torch.Tensor, env_ids: EnvIds = None
) -> None:
    """Write `values`, (N, n), to columns of `target`, (N, m), in all rows or in rows `env_ids`."""
    if isinstance(columns, slice):
        if env_ids is None:
            target[:, columns] = values
        else:
            target[env_ids, columns] = values[env_ids]
    elif env_ids is None:
        target.index_copy_(1, columns, values)
    else:
        rows = as_ids(env_ids, target.shape[0], target.device)
        target[rows[:, None], columns] = values[rows]
