"""Dotted paths of settings in configs, such as `sim.engine`."""

from __future__ import annotations

from collections.abc import Iterable

OF_THE_MACHINE = ("seed", "scene.num_envs", "sim.engine", "sim.num_threads", "sim.nan_guard")
"""Settings of an environment that are of the machine or of the session, not of the task."""


def is_below(path: str, parents: Iterable[str]) -> bool:
    """Return True if `path` is one of `parents`, or inside one."""
    return any(path == one or path.startswith(f"{one}.") for one in parents)
