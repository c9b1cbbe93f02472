"""MuJoCo's warnings: counted by kind, and logged once each.

By itself MuJoCo prints every warning and appends it to `MUJOCO_LOG.TXT` in the working folder, which
robots that diverge in many environments turn into gigabytes.
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
    """Log and count the warnings of MuJoCo in this process, unless a handler is set already."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_take)


def mujoco_warnings() -> dict[str, int]:
    """Return how often MuJoCo has warned in this process, by kind: the text without its numbers."""
    with _lock:
        return dict(_counts)


def _take(text: str) -> None:
    # Called on the threads of the physics.
    kind = _NUMBERS.sub("#", text)
    with _lock:
        _counts[kind] += 1
        is_new = _counts[kind] == 1
    if is_new:
        logger.warning(
            "MuJoCo: %s Further warnings of this kind are counted.", text.rstrip(". ") + "."
        )
