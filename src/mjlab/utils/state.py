"""Capture and restore the run-time state of an object tree, for runs that resume bit for bit.

Managers, terms, buffers and actuators keep their run-time state in plain attributes. Instead of
asking every one of them (and every term a user writes) for a `state_dict`, this module walks the
attributes of objects whose class is marked `stateful` and saves what is data: tensors, numbers,
strings, and lists, tuples and dicts of those.
"""

from __future__ import annotations

import logging
from typing import Any, TypeVar

import torch

logger = logging.getLogger(__name__)

C = TypeVar("C", bound=type)

_MARK = "_is_stateful"
_TRANSIENT = "_transient"
_SCALARS = (bool, int, float, str, type(None))


class _Skip:
    """Stands for a value that is not state."""


_SKIP = _Skip()


def stateful(cls: C) -> C:
    """Class decorator: attributes of instances (subclasses included) are run-time state.

    Attributes named in the class attribute `_transient` (a set of names; those of base classes
    count too) are left out: caches, and views of simulation tensors.
    """
    setattr(cls, _MARK, True)
    return cls


def capture_state(obj: Any) -> dict[str, Any]:
    """Return a copy of the run-time state of `obj`, whose class is marked `stateful`.

    The result holds only tensors, numbers, strings, None, lists, tuples and dicts, so it can be
    saved by `torch.save` and loaded with `weights_only=True`.
    """
    return _capture_object(obj, set())


def restore_state(obj: Any, state: dict[str, Any]) -> None:
    """Write `state`, made by `capture_state`, back into `obj`.

    Tensors are written in place where shape and type agree, so that references stay valid.
    Entries for attributes that `obj` no longer has are logged and left out.
    """
    transient = _transient_names(type(obj))
    for name, value in state.items():
        if name in transient:
            continue
        if name not in obj.__dict__:
            logger.warning("Saved state has %s.%s, which does not exist.", type(obj).__name__, name)
            continue
        obj.__dict__[name] = _restored(obj.__dict__[name], value)


def _transient_names(cls: type) -> set[str]:
    names: set[str] = set()
    for base in cls.__mro__:
        names |= set(base.__dict__.get(_TRANSIENT, ()))
    return names


def _capture_object(obj: Any, seen: set[int]) -> dict[str, Any]:
    seen.add(id(obj))
    transient = _transient_names(type(obj))
    state = {}
    for name, value in vars(obj).items():
        if name in transient:
            continue
        captured = _capture_value(value, seen)
        if captured is not _SKIP:
            state[name] = captured
    return state


def _capture_value(value: Any, seen: set[int]) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    if isinstance(value, _SCALARS):
        return value
    if getattr(type(value), _MARK, False):
        # An object reached twice is saved once: state is a tree.
        return _SKIP if id(value) in seen else _capture_object(value, seen)
    # Sequences keep their length, so that items that are not state hold their place.
    if type(value) in (list, tuple):
        items = [_capture_value(item, seen) for item in value]
        if items and all(item is _SKIP for item in items):
            return _SKIP
        return [None if item is _SKIP else item for item in items]
    if type(value) is dict and all(isinstance(key, (str, int)) for key in value):
        entries = {key: _capture_value(item, seen) for key, item in value.items()}
        kept = {key: item for key, item in entries.items() if item is not _SKIP}
        return _SKIP if value and not kept else kept
    return _SKIP


def _restored(current: Any, saved: Any) -> Any:
    """Return what the attribute now holding `current` should hold to match `saved`."""
    if isinstance(saved, torch.Tensor):
        return _restored_tensor(current, saved)
    if getattr(type(current), _MARK, False):
        restore_state(current, saved)
        return current
    if type(current) in (list, tuple) and isinstance(saved, list):
        if len(current) != len(saved):
            return type(current)(saved)
        items = [_restored(item, value) for item, value in zip(current, saved, strict=True)]
        return type(current)(items)
    if type(current) is dict and isinstance(saved, dict):
        for key, value in saved.items():
            current[key] = _restored(current.get(key), value)
        return current
    # A place that holds something which is not state was saved as None: leave it alone.
    if saved is None and not isinstance(current, (*_SCALARS, torch.Tensor)):
        return current
    return saved


def _restored_tensor(current: Any, saved: torch.Tensor) -> torch.Tensor:
    if not isinstance(current, torch.Tensor):
        return saved.clone()
    same = current.shape == saved.shape and current.dtype == saved.dtype
    if not same or current.requires_grad:
        return saved.to(current.device)
    current.copy_(saved)
    return current
