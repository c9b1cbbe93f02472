"""Seeds: of every random number generator, and of the parts of a run that must not draw alike.

Generators are seeded with 32 bits. The lower half of them is for the processes of a run, the third
quarter for evaluations, the last for sessions of several processes after a resume. So no part of a
run draws the numbers of another, and neither does any of a run whose `--agent.seed` differs, as long
as that is below 2**20 and there are at most 1,000 processes.
"""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Generator
from typing import Any

import numpy as np
import torch

from mjlab.utils.errors import check_in_range

_MAX_SEED = 2**32 - 1
_PROCESS_STRIDE = 2**20
_EVALUATIONS, _SESSIONS = 2**31, 2**31 + 2**30
# Odd, and near 2**32 over the golden ratio: multiples by small numbers lie far apart.
_SPREAD = 0x9E3779B1


def draw_seed() -> int:
    """Return a seed from 0 to 9999 drawn from the system's entropy, whatever was seeded before."""
    return int(np.random.default_rng().integers(0, 10_000))


def seed_rng(seed: int, torch_deterministic: bool = False) -> None:
    """Seed the generators of Python, NumPy and torch (CPU and GPUs).

    `PYTHONHASHSEED` is set too: it does not change this process, but the ones it starts.

    Args:
        seed: An integer from 0 to 2**32 - 1.
        torch_deterministic: Also make torch choose deterministic algorithms, with a warning where
            an operation has none.

    Raises `ValueError` if the seed is out of range.
    """
    check_in_range("seed", seed, 0, _MAX_SEED)
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


def rng_state() -> dict[str, Any]:
    """Return the states of torch (CPU and GPUs), NumPy and Python as tensors and numbers."""
    kind, keys, position, has_gauss, cached_gaussian = np.random.get_state(legacy=True)
    if kind != "MT19937":
        raise ValueError(f"NumPy's global generator is {kind}; only MT19937 can be saved.")
    version, words, next_gauss = random.getstate()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": {
            "keys": torch.from_numpy(np.asarray(keys).astype(np.int64)),
            "position": int(position),
            "has_gauss": int(has_gauss),
            "cached_gaussian": float(cached_gaussian),
        },
        "python": {
            "version": version,
            "words": torch.from_numpy(np.array(words, dtype=np.int64)),
            "next_gauss": next_gauss,
        },
    }
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        state["cuda"] = [value.cpu() for value in torch.cuda.get_rng_state_all()]
    return state


def set_rng_state(state: dict[str, Any]) -> None:
    """Restore what `rng_state` returned. States of GPUs that are not there are left out."""
    torch.set_rng_state(state["torch"].cpu())
    saved = state["numpy"]
    keys = saved["keys"].cpu().numpy().astype(np.uint32)
    np.random.set_state(
        ("MT19937", keys, saved["position"], saved["has_gauss"], saved["cached_gaussian"])
    )
    saved = state["python"]
    words = tuple(saved["words"].tolist())
    random.setstate((saved["version"], words, saved["next_gauss"]))
    if "cuda" in state and torch.cuda.is_available():
        for device, value in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(value.cpu(), device)


@contextlib.contextmanager
def preserved_rng() -> Generator[None]:
    """Put all generators back, after the block, to where they were before it."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


def process_seed(seed: int, rank: int) -> int:
    """Return the seed of process `rank` of a run with `seed`; that of the first is `seed` itself."""
    return seed if rank == 0 else (seed + rank * _PROCESS_STRIDE) % 2**32


def session_seed(seed: int, iteration: int) -> int:
    """Return the seed of a process with `seed` whose run is resumed after `iteration` iterations.

    For runs of which a checkpoint does not hold the generators.
    """
    return _SESSIONS + _spread(seed, iteration)


def evaluation_seed(seed: int, iteration: int = 0) -> int:
    """Return a seed for evaluations of a run with `seed`.

    Args:
        seed: Seed of the run.
        iteration: Each gives other episodes; 0 is for those that are the same in all evaluations.
    """
    return _EVALUATIONS + _spread(seed, iteration)


def _spread(seed: int, iteration: int) -> int:
    return (seed * _SPREAD + iteration) % 2**30
