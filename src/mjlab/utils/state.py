"""Capture and restore the run-time state of an object tree: checkpoints, and calls without effect.

Managers, terms, buffers and actuators keep their run-time state in plain attributes. Instead of
requiring a `state_dict` of each class (and of users' terms), this module walks the attributes of
objects whose class is marked `stateful` and saves all data: tensors, arrays, numbers, strings,
random generators, and lists, tuples, deques and dicts of these. `changes_undone` also walks objects
of other classes, because it needs no names for them in a file.
"""

from __future__ import annotations

import contextlib
import enum
import inspect
import logging
import math
import sys
from collections import deque
from collections.abc import Generator, Sequence
from types import ModuleType, SimpleNamespace
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
_ROW_DIMS = "_row_dims"
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


@contextlib.contextmanager
def changes_undone(
    roots: Sequence[Any],
    env_ids: torch.Tensor | None = None,
    num_envs: int = 0,
    *,
    generators: bool = True,
    shared: tuple[type, ...] = (),
) -> Generator[list[int]]:
    """Undo the changes of the block to the objects in `roots`, except rows `env_ids`.

    Attributes, items and values of objects, containers, tensors and arrays are restored, and
    references to these stay valid. Rows are those of tensors and arrays with `num_envs` as first or
    second dimension, and items of sequences and dicts with one item per environment. Other state,
    such as counters and running means, is restored completely. Tensors of more than 2**20 values
    without rows are data and are not restored.

    Args:
        roots: Objects whose state is kept, with all that they own.
        env_ids: Environments that keep their changes, (n,) int64. None: no environment.
        num_envs: Number of environments.
        generators: Restore random number generators.
        shared: Classes of objects that the roots refer to but do not own.

    Yields a list. After the block it holds the indices of the roots whose state outside `env_ids`
    changed; it stays empty without `env_ids`.
    """
    tables = [_noted(root, {}, shared, num_envs) for root in roots]
    changed: list[int] = []
    try:
        yield changed
    finally:
        if env_ids is not None:
            rows = _Rows(env_ids, num_envs, shared)
            for k, (root, table) in enumerate(zip(roots, tables, strict=True)):
                if rows.take(table, root, root, set()):
                    changed.append(k)
        with torch.no_grad():
            for table in tables:
                for value, kept in table.values():
                    _put_back(value, kept, table, generators)


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


# Larger tensors without rows are data, such as motions, and not copied at every reset.
_LARGEST = 2**20

# State of objects in the same process: original objects with copies of their contents, by `id`.
_Table = dict[int, tuple[Any, Any]]


def _noted(value: Any, table: _Table, shared: tuple[type, ...], num_envs: int) -> _Table:
    """Add `value` and all that it owns to `table`."""
    if id(value) in table:
        return table
    if isinstance(value, (torch.Tensor, np.ndarray)):
        is_table = math.prod(value.shape) > _LARGEST and num_envs not in value.shape[:2]
        if isinstance(value, np.ndarray):
            if value.dtype.kind in "biuf" and not is_table:
                table[id(value)] = value, value.copy()
        elif not (is_table or isinstance(value, torch.nn.Parameter)) and _owns_its_values(value):
            table[id(value)] = value, value.detach().clone()
    elif isinstance(value, torch.Generator):
        table[id(value)] = value, value.get_state()
    elif isinstance(value, np.random.Generator):
        table[id(value)] = value, value.bit_generator.state
    elif (parts := _parts(value, shared)) is not None:
        table[id(value)] = value, parts
        for part in parts.values():
            _noted(part, table, shared, num_envs)
    return table


def _parts(value: Any, shared: tuple[type, ...]) -> dict[Any, Any] | None:
    """Return items or attributes of a container or an object; None for other values."""
    if isinstance(value, (list, tuple, deque, set)):
        return dict(enumerate(value))
    if isinstance(value, dict):
        return dict(value)
    if not _is_owned(value, shared):
        return None
    transient = _transient_names(type(value))
    return {name: part for name, part in vars(value).items() if name not in transient}


def _is_owned(value: Any, shared: tuple[type, ...]) -> bool:
    if isinstance(value, shared):
        return False
    if is_stateful(value) or isinstance(value, SimpleNamespace):
        return True
    if not hasattr(value, "__dict__") or isinstance(value, (type, ModuleType, enum.Enum)):
        return False
    # The environment, configs and MuJoCo objects, also of subclasses, belong to others.
    homes = {base.__module__.partition(".")[0] for base in type(value).__mro__}
    is_library = type(value).__module__.partition(".")[0] in sys.stdlib_module_names
    return not (is_library or inspect.isroutine(value) or homes & {"mjlab", "mujoco", "warp"})


def _put_back(value: Any, kept: Any, table: _Table, generators: bool) -> None:
    """Restore the contents `kept` of an original object."""
    if isinstance(value, torch.Tensor):
        if not _is_locked(value):
            value.copy_(kept)
    elif isinstance(value, np.ndarray):
        value[...] = kept
    elif isinstance(value, torch.Generator):
        if generators:
            value.set_state(kept)
    elif isinstance(value, np.random.Generator):
        if generators:
            value.bit_generator.state = kept
    elif not isinstance(value, tuple):
        # Tensors that cannot be written are replaced.
        parts = {
            name: table[id(part)][1] if _is_locked(part) and id(part) in table else part
            for name, part in kept.items()
        }
        if isinstance(value, list):
            value[:] = parts.values()
        elif isinstance(value, deque):
            value.clear()
            value.extend(parts.values())
        elif isinstance(value, set):
            value.clear()
            value.update(parts.values())
        elif isinstance(value, dict):
            value.clear()
            value.update(parts)
        else:
            held = vars(value)
            for name in held.keys() - parts.keys() - _transient_names(type(value)):
                del held[name]
            held.update(parts)


def _is_locked(value: Any) -> bool:
    """Return True for inference tensors outside `inference_mode`."""
    is_inference = isinstance(value, torch.Tensor) and value.is_inference()
    return is_inference and not torch.is_inference_mode_enabled()


class _Rows:
    """Moves rows of environments from current objects into the noted contents of originals."""

    def __init__(self, env_ids: torch.Tensor, num_envs: int, shared: tuple[type, ...]) -> None:
        self._ids, self._num_envs, self._shared = env_ids.cpu(), num_envs, shared

    def take(
        self, table: _Table, old: Any, now: Any, seen: set[int], dim: int | None = None
    ) -> bool:
        """Take the rows of `old` from `now`; return True if other values differ."""
        if id(old) not in table:
            both = plain_scalar(old), plain_scalar(now)
            return old is not now and (SKIP in both or both[0] != both[1])
        if id(old) in seen:
            return False
        seen.add(id(old))
        kept = table[id(old)][1]
        if isinstance(old, (torch.Tensor, np.ndarray)):
            return self._take_values(kept, now, dim)
        current = _parts(now, self._shared) if type(now) is type(old) else None
        if current is None:
            return isinstance(kept, dict)
        differs = current.keys() != kept.keys()
        if isinstance(old, (list, tuple, deque, dict)) and self._is_per_env(kept, current):
            for k in self._ids.tolist():
                _forget(table, kept[k])
                kept[k] = current[k]
        dims = getattr(type(old), _ROW_DIMS, {})
        for name, part in list(kept.items()):
            now = current.get(name)
            differs |= self.take(table, part, now, seen, dims.get(name))
            if part is None and self._is_created(now):
                kept[name] = now
        kept |= {k: v for k, v in current.items() if k not in kept and self._is_created(v)}
        return differs

    def _take_values(self, kept: Any, now: Any, dim: int | None) -> bool:
        if type(now) is not type(kept) or (now.shape, now.dtype) != (kept.shape, kept.dtype):
            return True
        dim = self._dim(now) if dim is None else dim
        both = torch.as_tensor(kept), torch.as_tensor(now)
        if dim is None:
            return not torch.equal(*both)
        old, new = (values.movedim(dim, 0) for values in both)
        ids = self._ids.to(old.device)
        old[ids] = new[ids]
        return not torch.equal(old, new)

    def _dim(self, value: Any) -> int | None:
        """Return the dimension of rows of a tensor or array; None if it has none."""
        if not isinstance(value, (torch.Tensor, np.ndarray)):
            return None
        sizes = tuple(value.shape[:2])
        return sizes.index(self._num_envs) if self._num_envs in sizes else None

    def _is_created(self, value: Any) -> bool:
        """Return True for per-environment values to keep, if the block created them."""
        return len(self._ids) > 0 and self._dim(value) is not None

    def _is_per_env(self, kept: dict[Any, Any], current: dict[Any, Any]) -> bool:
        if not kept.keys() == current.keys() == set(range(self._num_envs)):
            return False
        noted = [_noted(part, {}, self._shared, self._num_envs) for part in kept.values()]
        return all(self._dim(value) is None for table in noted for value, _ in table.values())


def _forget(table: _Table, value: Any) -> None:
    """Remove `value` and all that it owns from `table`."""
    _, kept = table.pop(id(value), (None, None))
    for part in kept.values() if isinstance(kept, dict) else ():
        _forget(table, part)
