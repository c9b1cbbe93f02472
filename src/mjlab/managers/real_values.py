"""Refusing tensors that torch would cast in silence, or fail on without saying whose they are."""

from __future__ import annotations

import torch


def check_real(label: str, value: torch.Tensor) -> None:
    """Raise TypeError, with `label`, for complex numbers, and for a tensor without data (`meta`)."""
    if value.is_complex() or value.is_meta:
        kind = "the device meta" if value.is_meta else str(value.dtype).removeprefix("torch.")
        raise TypeError(f"{label}: expected real numbers, got a tensor of {kind}.")
