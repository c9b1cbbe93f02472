"""What to do with observations that are NaN or infinite."""

from __future__ import annotations

import logging
from typing import Literal

import torch

logger = logging.getLogger(__name__)

NanPolicy = Literal["disabled", "warn", "sanitize", "error"]
NAN_POLICIES = ("disabled", "warn", "sanitize", "error")


def apply_nan_policy(value: torch.Tensor, policy: NanPolicy, label: str) -> torch.Tensor:
    """Return `value` (num_envs, ...) after the policy.

    "disabled" looks at nothing, "sanitize" replaces NaN and infinite numbers by 0, "warn" logs the
    environments first, and "error" raises `ValueError` with `label` and up to 10 environments.
    """
    if policy == "disabled":
        return value
    if policy != "sanitize":
        bad = ~torch.isfinite(value).flatten(1).all(dim=1)
        if not bad.any():
            return value
        ids = bad.nonzero().flatten()
        shown = ids[: 10 if policy == "error" else 5].tolist()
        message = f"Observation {label!r} is NaN or infinite in {len(ids)} environments: {shown}"
        message += " and others." if len(ids) > len(shown) else "."
        if policy == "error":
            raise ValueError(message)
        logger.warning("%s Replaced by 0.", message)
    return torch.nan_to_num(value, nan=0.0, posinf=0.0, neginf=0.0)
