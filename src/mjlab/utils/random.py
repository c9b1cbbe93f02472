"""Seeding of every random number generator a run draws from."""

from __future__ import annotations

import os
import random

import numpy as np
import torch

_MAX_SEED = 2**32 - 1


def seed_rng(seed: int, torch_deterministic: bool = False) -> None:
    """Seed the generators of Python, NumPy and torch (CPU and GPUs).

    `PYTHONHASHSEED` is set too: it does not change this process, but the ones it starts.

    Args:
        seed: An integer from 0 to 2**32 - 1.
        torch_deterministic: Also make torch choose deterministic algorithms, with a warning where
            an operation has none.

    Raises `ValueError` if the seed is out of range.
    """
    if not 0 <= seed <= _MAX_SEED:
        raise ValueError(f"The seed is {seed}; it must be from 0 to {_MAX_SEED}.")
    os.environ["PYTHONHASHSEED"] = str(seed)
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    if torch_deterministic:
        # cuBLAS is only reproducible with a fixed workspace, read when it starts.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        # The same as `use_deterministic_algorithms(True, warn_only=True)`, which would load
        # torch's compiler first (seconds).
        torch.set_deterministic_debug_mode("warn")
