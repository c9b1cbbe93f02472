"""The state of every random number generator, as plain data."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


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
            "words": torch.tensor(words, dtype=torch.int64),
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
    words = tuple(int(word) for word in saved["words"].tolist())
    random.setstate((saved["version"], words, saved["next_gauss"]))
    if "cuda" in state and torch.cuda.is_available():
        for device, value in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(value.cpu(), device)
