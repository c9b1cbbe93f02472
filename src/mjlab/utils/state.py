"""Capture and restore the run-time state of an object tree, for bitwise exact resume.

Managers, terms, buffers and actuators keep their run-time state in plain attributes. Instead of
requiring a `state_dict` of each class (and of users' terms), this module walks the attributes of
objects whose class is marked `stateful` and saves all data: tensors, arrays, numbers, strings,
random generators, and lists, tuples, deques and dicts of these.
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
# Marks the state of an object, to tell it from a plain dict.
_CLASS_KEY = "__class__"
# Attributes for device and size of an object, set by the new run.
_SETTINGS = frozenset({"device", "_device", "num_envs", "_num_envs"})
_TRANSIENT = "_transient"
# Exact types only: a torch.Size or named tuple describes an object, not its run-time state.
_SEQUENCES = (list, tuple, deque)


class _Skip:
    """Sentinel for values that are not state."""


SKIP = _Skip()


def stateful(cls: C) -> C:
    """Class decorator: mark instance attributes (also of subclasses) as run-time state.

    Attributes named in the class attribute `_transient` (a set, merged with those of base classes)
    are excluded: caches, config settings, and views of simulation tensors.
    """
    setattr(cls, _MARK, True)
    return cls


def is_stateful(obj: Any) -> bool:
    """Return True if the class of `obj` is marked `stateful`."""
    return getattr(type(obj), _MARK, False)


def capture_state(obj: Any, *, generators: bool = True) -> dict[str, Any]:
    """Return a copy of the run-time state of `obj`, an instance of a `stateful` class.

    The result holds only tensors, numbers, strings, None, lists and dicts, so it can be saved by
    `torch.save` and loaded with `weights_only=True`.

    Args:
        obj: The object.
        generators: Include the state of random generators.
    """
    return _capture_object(obj, set(), generators)


def restore_state(obj: Any, state: dict[str, Any]) -> None:
    """Restore the `state` of `obj` captured by `capture_state`.

    Tensors are written in place if shape and type agree, so that references stay valid. Missing
    attributes, such as those created at the first call, are created.
    """
    transient = _transient_names(type(obj))
    for name, value in state.items():
        if name in transient or name == _CLASS_KEY:
            continue
        current = obj.__dict__.get(name)
        is_object = isinstance(value, dict) and _CLASS_KEY in value
        if is_object and not is_stateful(current):
            logger.warning(
                "%s.%s not restored: expected a %s, got %r.",
                type(obj).__name__, name, value[_CLASS_KEY], current,
            )  # fmt: skip
            continue
        obj.__dict__[name] = _restored(current, value)


def shape_differences(saved: Any, current: Any, path: str = "") -> list[str]:
    """Return descriptions of tensors whose shapes differ between two captured states.

    Values in only one of the states are not differences, because some state is created at the first
    call.
    """
    if isinstance(saved, torch.Tensor) and isinstance(current, torch.Tensor):
        if saved.shape == current.shape:
            return []
        return [f"{path}: expected shape {tuple(current.shape)}, got {tuple(saved.shape)}"]
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
    """Return `value` as exactly None, bool, int, float or str; `SKIP` for other types.

    Subclasses (mainly NumPy scalars) are converted, because checkpoints with them cannot be loaded
    with `weights_only=True`.
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
        # Objects reached twice are saved once: state is a tree.
        if id(value) in seen:
            return SKIP
        return {_CLASS_KEY: type(value).__name__, **_capture_object(value, seen, generators)}
    # Sequences keep their length: items that are not state are saved as None.
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
    """Return True unless elements share memory (expanded tensor) or the tensor is a guarded view."""
    if type(tensor) not in (torch.Tensor, torch.nn.Parameter):
        return False
    return not any(
        stride == 0 and size > 1 for stride, size in zip(tensor.stride(), tensor.shape, strict=True)
    )


def _restored(current: Any, saved: Any) -> Any:
    """Return the value that restores `saved` in an attribute that holds `current`."""
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
    # Values that are not state were saved as None: keep them.
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
    # Inference tensors cannot be written outside `inference_mode`.
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
