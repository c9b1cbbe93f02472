"""Capture and restore the run-time state of an object tree: checkpoints, and calls without effect.

Managers, terms, buffers and actuators keep their run-time state in plain attributes. Instead of
requiring a `state_dict` of each class (and of users' terms), this module walks the attributes of
objects whose class is marked `stateful` and saves all data: tensors, arrays, numbers, strings,
random generators, and lists, tuples, deques and dicts of these.
"""

from __future__ import annotations

import contextlib
import enum
import logging
from collections import deque
from collections.abc import Generator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch

logger = logging.getLogger(__name__)
C = TypeVar("C", bound=type)
_MARK = "_is_stateful"
CLASS_KEY = "__class__"
"""Key of the class in the state of an object, to tell it from a plain dict."""
# Attributes for device and size of an object, set by the new run.
_SETTINGS = frozenset({"device", "_device", "num_envs", "_num_envs"})
_TRANSIENT = "_transient"
# Tensors whose rows are not along the first dimension of `num_envs` elements, by class and attribute.
_ROW_DIMS = {("CircularBuffer", "_buffer"): 1}
# Exact types only: a torch.Size or named tuple describes an object, not its run-time state.
_SEQUENCES = (list, tuple, deque)


SKIP = object()
"""Stands for values that are not state."""


def stateful(cls: C) -> C:
    """Class decorator: mark instance attributes (also of subclasses) as run-time state.

    Attributes named in the class attribute `_transient` (a set, merged with those of base classes)
    are excluded: caches, config settings, and views of simulation tensors.
    """
    setattr(cls, _MARK, True)
    return cls


def mark_stateful(obj: Any, num_envs: int) -> None:
    """Mark the class of `obj`, and those of helpers in it with a row per environment, such as filters.

    Helpers are objects of the same package. Others, such as motions, hold data and no state.
    """
    with contextlib.suppress(TypeError):
        # Types that no class statement created, such as functools.partial, hold no state; that in
        # `__slots__` is not read.
        if hasattr(obj, "__dict__"):
            stateful(type(obj))
    for value in getattr(obj, "__dict__", {}).values():
        items = value.values() if isinstance(value, dict) else value
        for part in items if isinstance(value, (*_SEQUENCES, dict)) else (value,):
            if not is_stateful(part) and _is_helper(part, type(obj), num_envs):
                mark_stateful(part, num_envs)


def is_stateful(obj: Any) -> bool:
    """Return True if the class of `obj` is marked `stateful`."""
    return getattr(type(obj), _MARK, False)


def capture_state(
    obj: Any, *, generators: bool = True, without: Sequence[Any] = ()
) -> dict[str, Any]:
    """Return a copy of the run-time state of `obj`, an instance of a `stateful` class.

    The result holds only tensors, numbers, strings, None, lists and dicts, so it can be saved by
    `torch.save` and loaded with `weights_only=True`.

    Args:
        obj: The object.
        generators: Include the state of random generators.
        without: Objects to leave out.
    """
    return _capture_object(obj, {id(part) for part in without}, generators)


def capture_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of the data in `values`, without random generators; see `capture_state`."""
    captured = {name: _capture_value(value, set(), False) for name, value in values.items()}
    return {name: value for name, value in captured.items() if value is not SKIP}


def restore_state(obj: Any, state: dict[str, Any]) -> None:
    """Restore the `state` of `obj` captured by `capture_state`.

    Tensors are written in place if shape and type agree, so that references stay valid. Missing
    attributes, such as those created at the first call, are created.
    """
    transient = _transient_names(type(obj))
    for name, value in state.items():
        if name in transient or name == CLASS_KEY:
            continue
        current = obj.__dict__.get(name)
        is_object = isinstance(value, dict) and CLASS_KEY in value
        if is_object and not is_stateful(current):
            logger.warning(
                "%s.%s not restored: expected a %s, got %r.",
                type(obj).__name__, name, value[CLASS_KEY], current,
            )  # fmt: skip
            continue
        obj.__dict__[name] = restored(current, value)


@contextlib.contextmanager
def changes_undone(
    objects: Sequence[Any],
    env_ids: torch.Tensor | None = None,
    num_envs: int = 0,
    *,
    generators: bool = True,
) -> Generator[list[dict[str, Any]]]:
    """Undo the changes of the block to the state of `objects`, except rows `env_ids`.

    Rows are those of tensors and arrays with `num_envs` as first or second dimension, and items of
    sequences with one item per environment. Other state, such as counters and running means, is
    restored completely.

    Args:
        objects: Instances of `stateful` classes.
        env_ids: Environments that keep their changes, (n,) int64. None: no environment.
        num_envs: Number of environments.
        generators: Restore random generators.

    Yields the states captured before the block.
    """
    before = [capture_state(obj, generators=generators) for obj in objects]
    try:
        yield before
    finally:
        for obj, state in zip(objects, before, strict=True):
            if env_ids is not None:
                after = capture_state(obj, generators=generators)
                state = _with_rows(state, after, env_ids.tolist(), num_envs)
            for name in vars(obj).keys() - state.keys() - _transient_names(type(obj)):
                # A counter created in the block, which hides an attribute of the class.
                if plain_scalar(vars(obj)[name]) is not SKIP:
                    delattr(obj, name)
            restore_state(obj, state)


def _with_rows(
    before: Any, after: Any, ids: list[int], num_envs: int, dim: int | None = None
) -> Any:
    """Return the captured state `before` with rows `ids`, along `dim`, of `after`."""
    if isinstance(before, torch.Tensor) and isinstance(after, torch.Tensor):
        if num_envs not in before.shape[:2] or before.shape != after.shape:
            return before
        dim = before.shape.index(num_envs) if dim is None else dim
        merged = before.clone()
        merged.movedim(dim, 0)[ids] = after.movedim(dim, 0)[ids].to(merged.dtype)
        return merged
    if isinstance(before, dict) and isinstance(after, dict):
        owner = before.get(CLASS_KEY)
        return {
            name: _with_rows(value, after.get(name), ids, num_envs, _ROW_DIMS.get((owner, name)))
            for name, value in before.items()
        }
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        if len(before) == num_envs and not any(isinstance(x, (torch.Tensor, dict)) for x in before):
            return [after[k] if k in ids else value for k, value in enumerate(before)]
        pairs = zip(before, after, strict=True)
        return [_with_rows(old, new, ids, num_envs) for old, new in pairs]
    # A tensor created by the block is kept.
    return after if before is None and isinstance(after, torch.Tensor) else before


def shape_differences(saved: Any, current: Any, path: str = "") -> list[str]:
    """Return descriptions of tensors whose shapes differ between two captured states, and of values
    in place of objects.

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
    if isinstance(current, dict) and CLASS_KEY in current and saved is not None:
        return [f"{path}: expected a {current[CLASS_KEY]}, got a {type(saved).__name__}"]
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
        return {CLASS_KEY: type(value).__name__, **_capture_object(value, seen, generators)}
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


def _is_helper(obj: Any, owner: type, num_envs: int) -> bool:
    package = owner.__module__.partition(".")[0]
    if isinstance(obj, type) or type(obj).__module__.partition(".")[0] != package:
        return False
    if any(base.__module__.startswith("mjlab.") for base in type(obj).__mro__):
        return False  # Environments and entities save their own state.
    values = getattr(obj, "__dict__", {}).values()
    arrays = [value for value in values if isinstance(value, (torch.Tensor, np.ndarray))]
    return any(array.shape[:1] == (num_envs,) for array in arrays)


def restored(current: Any, saved: Any) -> Any:
    """Return the value that restores `saved` in an attribute that holds `current`."""
    if isinstance(saved, torch.Tensor):
        return _restored_tensor(current, saved)
    if is_stateful(current):
        restore_state(current, saved)
        return current
    if type(current) in _SEQUENCES and isinstance(saved, list):
        if len(current) == len(saved):
            saved = [restored(item, value) for item, value in zip(current, saved, strict=True)]
        if isinstance(current, deque):
            return deque(saved, maxlen=current.maxlen)
        return type(current)(saved)
    if isinstance(current, dict) and isinstance(saved, dict):
        for key, value in saved.items():
            current[key] = restored(current.get(key), value)
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
