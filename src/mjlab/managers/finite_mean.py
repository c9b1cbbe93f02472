"""Means over environments that one diverged environment does not spoil."""

from __future__ import annotations

import torch


def finite_mean(values: torch.Tensor) -> torch.Tensor:
    """Return the mean over the last axis, leaving out NaN and infinite values; 0 if none is left.

    Args:
        values: Float tensor (..., E) with one value for each of E environments.
    """
    # `isfinite` takes twice the operations.
    finite = values.abs() < torch.inf
    return torch.where(finite, values, 0.0).sum(dim=-1) / finite.sum(dim=-1).clamp(min=1)
