"""Refusing actions that are NaN or infinite."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

_SHOWN = 10


def finite_action_check(
    num_envs: int, action_dim: int, device: str
) -> Callable[[torch.Tensor], None]:
    """Return the check for this device: it raises `ValueError` for actions that are not finite."""
    if torch.device(device).type == "cuda":
        return DeferredCheck(num_envs, action_dim, device, torch.cuda.Event())
    return check_now


def check_now(action: torch.Tensor) -> None:
    """Raise `ValueError`, naming environments and values, if `action` (N, A) is not finite."""
    # One number tells for nearly every action that all is well; large ones may still overflow it.
    if math.isfinite(action.sum().item()):
        return
    bad = ~torch.isfinite(action).all(dim=1)
    if bad.any():
        raise ValueError(_message(bad, action))


class DeferredCheck:
    """Checks actions on a GPU without waiting for it: each call reports about earlier ones.

    A flag is copied to the host in the background; when the next call finds it there and set, that
    call raises. What was wrong is kept on the device until then.

    Args:
        num_envs: Number of environments N.
        action_dim: Number of action components A.
        device: Device of the actions.
        event: Tells when the copy is done; has `record()` and `query()` as `torch.cuda.Event`.
    """

    def __init__(self, num_envs: int, action_dim: int, device: str, event: Any) -> None:
        self._event = event
        self._bad = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._values = torch.zeros(num_envs, action_dim, dtype=torch.float32, device=device)
        pinned = torch.device(device).type == "cuda"
        self._flag = torch.zeros((), dtype=torch.bool, pin_memory=pinned)
        self._pending = False

    def __call__(self, action: torch.Tensor) -> None:
        """Raise `ValueError` if an earlier action was not finite, then look at this one."""
        if self._pending and self._event.query():
            self._pending = False
            if self._flag:
                message = _message(self._bad, self._values)
                self._bad.zero_()
                raise ValueError(f"In the previous step: {message}")
        bad = ~torch.isfinite(action).all(dim=1)
        torch.where(bad.unsqueeze(1), action.to(self._values), self._values, out=self._values)
        self._bad.logical_or_(bad)
        if not self._pending:
            self._flag.copy_(self._bad.any(), non_blocking=True)
            self._event.record()
            self._pending = True


def _message(bad: torch.Tensor, action: torch.Tensor) -> str:
    ids = bad.nonzero().flatten()
    rows = [f"env {i}: {action[i].tolist()}" for i in ids[:_SHOWN].tolist()]
    more = f", and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else ""
    return (
        f"Actions are NaN or infinite in {len(ids)} of {len(bad)} environments ({'; '.join(rows)}"
        f"{more}). Every action must be a finite number: check what the policy gets and returns."
    )
