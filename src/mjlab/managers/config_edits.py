"""What was changed in the configs of terms at run time, by curricula say.

Changes are run-time state: a run that resumes has to continue with them. Configs as a whole are
not, because whoever resumes may have set other values on purpose.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch

from mjlab.utils.state import SKIP, plain_scalar


def plain_values(cfg: Any) -> dict[str, Any]:
    """Return a copy of the plain values in a config, as nested dicts by field or key.

    Plain are numbers, strings, None, tensors, and lists and tuples of plain values.
    """
    values: dict[str, Any] = {}
    for key, value in _items(cfg):
        if callable(value):
            continue
        if _is_branch(value):
            values[key] = plain_values(value)
        else:
            plain = _plain(value)
            if plain is not SKIP:
                values[key] = plain
    return values


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of `now` differs from `before`; both come from `plain_values`."""
    changed: dict[str, Any] = {}
    for key, value in now.items():
        old = before.get(key)
        if isinstance(value, dict) and isinstance(old, dict):
            inner = changes(old, value)
            if inner:
                changed[key] = inner
        elif key not in before or not _same(old, value):
            changed[key] = value
    return changed


def write_changes(cfg: Any, changed: Mapping[str, Any]) -> None:
    """Write a result of `changes` into a config."""
    current = dict(_items(cfg))
    for key, value in changed.items():
        if isinstance(value, Mapping) and _is_branch(current.get(key)):
            write_changes(current[key], value)
        elif isinstance(cfg, dict):
            cfg[key] = value
        else:
            setattr(cfg, key, value)


def _items(cfg: Any) -> list[tuple[str, Any]]:
    if isinstance(cfg, dict):
        return [(key, value) for key, value in cfg.items() if isinstance(key, str)]
    return [(field.name, getattr(cfg, field.name)) for field in dataclasses.fields(cfg)]


def _is_branch(value: Any) -> bool:
    is_instance = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return isinstance(value, dict) or is_instance


def _plain(value: Any) -> Any:
    """Return a copy of a plain value, of exactly the built-in types, or SKIP."""
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, (list, tuple)):
        items = [_plain(item) for item in value]
        if any(item is SKIP for item in items):
            return SKIP
        return items if isinstance(value, list) else tuple(items)
    return plain_scalar(value)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return torch.equal(a, b)
    if type(a) in (list, tuple) and type(b) in (list, tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, torch.Tensor) or isinstance(b, torch.Tensor):
        return False
    return bool(a == b)
