"""Where environments are: a grid on flat ground, or the cells of a generated terrain."""

from __future__ import annotations

import math

import numpy as np
import torch


def grid_origins(num_envs: int, spacing: float, device: str) -> torch.Tensor:
    """Return (num_envs, 3) origins on a square grid, centred on the world's origin.

    With `rows = ceil(N / floor(sqrt N))` and `cols = ceil(N / rows)`, environment k is in row
    `i = k div cols` and column `j = k mod cols`, at
    `(-(i - (rows - 1) / 2) s, (j - (cols - 1) / 2) s, 0)`.
    """
    num_rows = math.ceil(num_envs / math.isqrt(num_envs))
    num_cols = math.ceil(num_envs / num_rows)
    index = torch.arange(num_envs, device=device)
    row = torch.div(index, num_cols, rounding_mode="floor")
    origins = torch.zeros(num_envs, 3, dtype=torch.float32, device=device)
    origins[:, 0] = -(row - (num_rows - 1) / 2) * spacing
    origins[:, 1] = (index % num_cols - (num_cols - 1) / 2) * spacing
    return origins


def assign_columns(
    num_envs: int, num_cols: int, proportions: np.ndarray | None, device: str
) -> torch.Tensor:
    """Return (num_envs,) terrain columns: each column gets a contiguous block of environments.

    With one proportion for each column, blocks are sized by them: every column first gets one
    environment (if there are enough), and the rest is split by largest remainder. Otherwise blocks
    are of equal size.
    """
    if proportions is None or len(proportions) != num_cols:
        index = torch.arange(num_envs, device=device)
        return torch.div(index * num_cols, num_envs, rounding_mode="floor")
    counts = torch.tensor(split_by_proportion(num_envs, np.asarray(proportions)), device=device)
    return torch.repeat_interleave(torch.arange(num_cols, device=device), counts)


def split_by_proportion(total: int, proportions: np.ndarray) -> list[int]:
    """Return how many of `total` each share gets: at least one where possible; sums to `total`.

    Raises:
        ValueError: a proportion is negative, or all are zero.
    """
    proportions = np.asarray(proportions, dtype=np.float64)
    if (proportions < 0.0).any() or proportions.sum() <= 0.0:
        raise ValueError(
            f"Terrain proportions {proportions.tolist()} must not be negative, and not all zero."
        )
    shares = proportions / proportions.sum()
    counts = np.full(len(shares), 1 if total >= len(shares) else 0)
    exact = shares * (total - counts.sum())
    # Products such as 0.3 * 10 must not fall below the whole number that they mean.
    whole = np.floor(exact + 1e-9).astype(int)
    counts += whole
    left_over = total - int(counts.sum())
    if left_over > 0:
        largest = np.argsort(exact - whole, kind="stable")[-left_over:]
        counts[largest] += 1
    return counts.tolist()
