"""Reading and writing columns of batched tensors, by slice wherever the columns are neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import torch

Columns = slice | torch.Tensor
EnvIds = torch.Tensor | slice | None


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
