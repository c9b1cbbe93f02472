"""MuJoCo warnings: counted by kind and logged once per kind.

By default MuJoCo prints every warning and appends it to `MUJOCO_LOG.TXT` in the working directory.
With robots diverging in many environments, that file grows to gigabytes.
"""

from __future__ import annotations

import logging
import re
import threading
from collections import Counter

import mujoco

logger = logging.getLogger(__name__)

_NUMBERS = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
_counts: Counter[str] = Counter()
_lock = threading.Lock()


def collect_mujoco_warnings() -> None:
    """Log and count MuJoCo's warnings in this process, unless a handler is already set."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_handle_warning)


def mujoco_warnings() -> dict[str, int]:
    """Return the number of MuJoCo warnings in this process by kind (text without numbers)."""
    with _lock:
        return dict(_counts)


def _handle_warning(text: str) -> None:
    # Called from physics threads.
    kind = _NUMBERS.sub("#", text)
    with _lock:
        _counts[kind] += 1
        is_new = _counts[kind] == 1
    if is_new:
        logger.warning(
            "MuJoCo: %s Further warnings of this kind are counted.", text.rstrip(". ") + "."
        )
