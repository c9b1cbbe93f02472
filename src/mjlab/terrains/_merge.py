"""Joining neighbouring cells of a grid into rectangles, for fewer geoms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def merge_equal_cells(
    values: np.ndarray, kept: np.ndarray, longest: int
) -> Iterator[tuple[int, int, int, int]]:
    """Yield rectangles of equal values that together hold each kept cell once.

    Cells are scanned along the second axis first. From each that is not taken yet, a rectangle
    grows along the first axis and then, by whole rows, along the second.

    Args:
        values: (n, m) values.
        kept: (n, m) whether each cell counts.
        longest: Most cells along an axis of a rectangle.

    Yields:
        First cell along both axes, and number of cells along both.
    """
    free = kept.copy()
    for i, j in np.argwhere(kept).tolist():
        if not free[i, j]:
            continue
        same = free & (values == values[i, j])
        num_i = _run(same[i : i + longest, j])
        block = same[i : i + num_i, j : j + longest].all(axis=0)
        num_j = _run(block)
        free[i : i + num_i, j : j + num_j] = False
        yield i, j, num_i, num_j


def _run(flags: np.ndarray) -> int:
    """Return how many of the first flags are set."""
    return len(flags) if flags.all() else int(np.argmin(flags))
