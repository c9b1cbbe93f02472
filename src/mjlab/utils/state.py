"""Capture and restore the run-time state of an object tree, for runs that resume bit for bit.

Managers, terms, buffers and actuators keep their run-time state in plain attributes. Instead of
asking every one of them (and every term a user writes) for a `state_dict`, this module walks the
attributes of objects whose class is marked `stateful` and saves what is data: tensors, arrays,
numbers, strings, random generators, and lists, tuples, deques and dicts of those.
"""

from __future__ import annotations

import enum
import logging
from collections import deque
from typing import Any, TypeVar

import numpy as np
import torch

logger = logging.getLogger(__name__)
C = TypeVar("C", bound=type)
_MARK = "_is_stateful"
# Marks what was captured from an object, to tell it from a plain dict.
_CLASS_KEY = "__class__"
# Attributes that say where and how large an object is; that is for the new run to decide.
_SETTINGS = frozenset({"device", "_device", "num_envs", "_num_envs"})
_TRANSIENT = "_transient"
# Exactly these: a torch.Size or a named tuple says what something is, not what has happened.
_SEQUENCES = (list, tuple, deque)


class _Skip:
    """Stands for a value that is not state."""


SKIP = _Skip()


def stateful(cls: C) -> C:
    """Class decorator: attributes of instances (subclasses included) are run-time state.

    Attributes named in the class attribute `_transient` (a set of names; those of base classes
    count too) are left out: caches, settings from the config, and views of simulation tensors.
    """
    setattr(cls, _MARK, True)
    return cls


def is_stateful(obj: Any) -> bool:
    """Return True if the class of `obj` is marked `stateful`."""
    return getattr(type(obj), _MARK, False)


def capture_state(obj: Any, *, generators: bool = True) -> dict[str, Any]:
    """Return a copy of the run-time state of `obj`, whose class is marked `stateful`.

    The result holds only tensors, numbers, strings, None, lists and dicts, so it can be saved by
    `torch.save` and loaded with `weights_only=True`.

    Args:
        obj: The object.
        generators: Include the state of random generators.
    """
    return _capture_object(obj, set(), generators)


def restore_state(obj: Any, state: dict[str, Any]) -> None:
    """Write `state`, made by `capture_state`, back into `obj`.

    Tensors are written in place where shape and type agree, so that references stay valid. An
    attribute that `obj` does not have yet, because it is made at the first call, is made.
    """
    transient = _transient_names(type(obj))
    for name, value in state.items():
        if name in transient or name == _CLASS_KEY:
            continue
        current = obj.__dict__.get(name)
        is_object = isinstance(value, dict) and _CLASS_KEY in value
        if is_object and not is_stateful(current):
            logger.warning(
                "%s.%s is not restored: it was a %s and is %r now.",
                type(obj).__name__, name, value[_CLASS_KEY], current,
            )  # fmt: skip
            continue
        obj.__dict__[name] = _restored(current, value)


def shape_differences(saved: Any, current: Any, path: str = "") -> list[str]:
    """Return where two captured states cannot be of the same objects: tensors of other shapes.

    What only one of them has is no difference: some state is made at the first call.
    """
    if isinstance(saved, torch.Tensor) and isinstance(current, torch.Tensor):
        if saved.shape == current.shape:
            return []
        return [f"{path} has shape {tuple(saved.shape)} there and {tuple(current.shape)} here"]
    if isinstance(saved, dict) and isinstance(current, dict):
        keys = [key for key in saved if key in current]
        parts = [shape_differences(saved[k], current[k], f"{path}.{k}".lstrip(".")) for k in keys]
        return [difference for part in parts for difference in part]
    if isinstance(saved, list) and isinstance(current, list):
        pairs = enumerate(zip(saved, current, strict=False))
        parts = [shape_differences(a, b, f"{path}[{i}]") for i, (a, b) in pairs]
        return [difference for part in parts for difference in part]
    return []


def plain_scalar(value: Any) -> Any:
    """Return `value` as exactly None, bool, int, float or str, or `SKIP` if it is none of these.

    Subclasses (numpy's numbers above all) are converted, because a checkpoint that holds them
    cannot be loaded as plain data.
    """
    if value is None:
        return None
    if isinstance(value, enum.Enum):
        return SKIP
    if isinstance(value, np.generic):
        value = value.item()
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return SKIP


def _capture_object(obj: Any, seen: set[int], generators: bool) -> dict[str, Any]:
    seen.add(id(obj))
    transient = _transient_names(type(obj))
    state: dict[str, Any] = {}
    for name, value in vars(obj).items():
        if name in transient:
            continue
        captured = _capture_value(value, seen, generators)
        if captured is not SKIP:
            state[name] = captured
    return state


def _capture_value(value: Any, seen: set[int], generators: bool) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().clone() if _owns_its_values(value) else SKIP
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy()) if value.dtype.kind in "biuf" else SKIP
    if isinstance(value, torch.Generator):
        return value.get_state() if generators else SKIP
    if is_stateful(value):
        # An object reached twice is saved once: state is a tree.
        if id(value) in seen:
            return SKIP
        return {_CLASS_KEY: type(value).__name__, **_capture_object(value, seen, generators)}
    # Sequences keep their length, so that items that are not state hold their place.
    if type(value) in _SEQUENCES:
        items = [_capture_value(item, seen, generators) for item in value]
        if items and all(item is SKIP for item in items):
            return SKIP
        return [None if item is SKIP else item for item in items]
    if isinstance(value, dict):
        if not all(type(key) in (str, int) for key in value):
            return SKIP
        entries = {key: _capture_value(item, seen, generators) for key, item in value.items()}
        kept = {key: item for key, item in entries.items() if item is not SKIP}
        return SKIP if value and not kept else kept
    return plain_scalar(value)


def _owns_its_values(tensor: torch.Tensor) -> bool:
    """Return whether each element is its own: not one value seen many times, nor a guarded view."""
    if type(tensor) not in (torch.Tensor, torch.nn.Parameter):
        return False
    return not any(
        stride == 0 and size > 1 for stride, size in zip(tensor.stride(), tensor.shape, strict=True)
    )


def _restored(current: Any, saved: Any) -> Any:
    """Return what the attribute now holding `current` should hold to match `saved`."""
    if isinstance(saved, torch.Tensor):
        return _restored_tensor(current, saved)
    if is_stateful(current):
        restore_state(current, saved)
        return current
    if type(current) in _SEQUENCES and isinstance(saved, list):
        if len(current) == len(saved):
            saved = [_restored(item, value) for item, value in zip(current, saved, strict=True)]
        if isinstance(current, deque):
            return deque(saved, maxlen=current.maxlen)
        return type(current)(saved)
    if isinstance(current, dict) and isinstance(saved, dict):
        for key, value in saved.items():
            current[key] = _restored(current.get(key), value)
        return current
    # A place that holds something which is not state was saved as None: leave it alone.
    if saved is None and not isinstance(current, torch.Tensor) and plain_scalar(current) is SKIP:
        return current
    return saved


def _restored_tensor(current: Any, saved: torch.Tensor) -> Any:
    if isinstance(current, torch.Generator):
        current.set_state(saved.cpu())
        return current
    if isinstance(current, np.ndarray):
        return saved.cpu().numpy().astype(current.dtype, copy=True)
    if not isinstance(current, torch.Tensor):
        return saved.clone()
    same = current.shape == saved.shape and current.dtype == saved.dtype
    # An inference tensor cannot be written outside `inference_mode`.
    is_locked = current.is_inference() and not torch.is_inference_mode_enabled()
    if not same or is_locked or current.requires_grad or not _owns_its_values(current):
        return saved.to(current.device)
    current.copy_(saved)
    return current


def _transient_names(cls: type) -> set[str]:
    names: set[str] = set(_SETTINGS)
    for base in cls.__mro__:
        names |= set(base.__dict__.get(_TRANSIENT, ()))
    return names
