"""Seeds of random number generators, and separate seeds for the parts of a run.

Seeds have 32 bits. The lower half of the range is for the processes of a run, the third quarter for
evaluations, the last quarter for multi-process sessions after a resume. So the parts of a run have
different random numbers, also for different `--agent.seed`, if seeds are below 2**20 and the number
of processes is at most 1,000.
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
_QUARTER = 2**30
# Odd, and close to 2**32 / golden ratio: small multiples are far apart.
_SPREAD = 0x9E3779B1


def draw_seed() -> int:
    """Return a seed in [0, 9999] from the system's entropy, independent of earlier seeding."""
    return int(np.random.default_rng().integers(0, 10_000))


def seed_rng(seed: int, torch_deterministic: bool = False) -> None:
    """Seed the generators of Python, NumPy and torch (CPU and GPUs).

    Also sets `PYTHONHASHSEED`, which affects child processes but not this process.

    Args:
        seed: An integer from 0 to 2**32 - 1.
        torch_deterministic: Also use deterministic torch algorithms, with a warning for
            operations without one.

    Raises `ValueError` if the seed is out of range.
    """
    check_in_range("seed", seed, 0, _MAX_SEED)
    os.environ["PYTHONHASHSEED"] = str(seed)
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    if torch_deterministic:
        # cuBLAS is only reproducible with a fixed workspace, configured before it starts.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        # Same as `use_deterministic_algorithms(True, warn_only=True)`, but without loading torch's
        # compiler (seconds).
        torch.set_deterministic_debug_mode("warn")


def rng_state() -> dict[str, Any]:
    """Return the states of torch (CPU and GPUs), NumPy and Python as tensors and numbers."""
    kind, keys, position, has_gauss, cached_gaussian = np.random.get_state(legacy=True)
    if kind != "MT19937":
        raise ValueError(f"NumPy's global generator: expected MT19937, got {kind}.")
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
    """Restore the result of `rng_state`. States of missing GPUs are skipped."""
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
    """Restore the states of all generators at the end of the block."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


def process_seed(seed: int, rank: int) -> int:
    """Return the seed of process `rank` of a run with `seed`; rank 0 gets `seed`."""
    return seed if rank == 0 else (seed + rank * _PROCESS_STRIDE) % 2**32


def session_seed(seed: int, iteration: int) -> int:
    """Return the seed of a process with `seed` whose run resumes after `iteration` iterations.

    For runs whose checkpoint does not contain the generator states.
    """
    return evaluation_seed(seed, iteration) + _QUARTER


def evaluation_seed(seed: int, iteration: int = 0) -> int:
    """Return a seed for evaluations of a run with `seed`.

    Args:
        seed: Seed of the run.
        iteration: Each iteration gives different episodes; 0 is for episodes that are the same
            in all evaluations.
    """
    return 2 * _QUARTER + (seed * _SPREAD + iteration) % _QUARTER
