"""Columns of observation terms in their group."""

from __future__ import annotations


def term_columns(env, group):
    """Yield the name of each term of a group, and its columns."""
    start = 0
    manager = env.observation_manager
    for name, (size,) in zip(
        manager.active_terms[group], manager.group_obs_term_dim[group], strict=True
    ):
        yield name, slice(start, start + size)
        start += size
