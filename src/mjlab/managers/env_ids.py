"""The ways to name environments: None (all), a slice, a bool mask or a 1-D integer tensor."""

from __future__ import annotations

import torch

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
