"""Plain data: what a checkpoint may hold, because loading it runs no code."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import numpy as np
import torch

# Exactly these: subclasses (enums, named tuples, numpy's float64) are pickled as calls of their
# class, which loading with `weights_only=True` refuses.
_ATOMS = (
    type(None), bool, int, float, complex, str, bytes,
    torch.Tensor, torch.nn.Parameter, torch.Size, torch.dtype, torch.device,
)  # fmt: skip
_DICTS = (dict, OrderedDict)
_SEQUENCES = (list, tuple, set)


def as_plain_data(value: Any, path: str = "") -> Any:
    """Return `value` with numpy's scalars as Python's; containers without any are returned as is.

    Args:
        value: Tensors, numbers, strings, None, and dicts, lists, tuples and sets of those.
        path: Where in a file `value` is to be, for the message.

    Raises:
        TypeError: something else is in there; the message says where and of which type.
    """
    if isinstance(value, np.generic):
        value = value.item()
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind in _DICTS:
        return _plain_dict(value, path)
    if kind in _SEQUENCES:
        items = [as_plain_data(item, f"{path}[{index}]") for index, item in enumerate(value)]
        same = all(one is other for one, other in zip(items, value, strict=True))
        return value if same else kind(items)
    raise TypeError(f"{path or 'it'} is a {kind.__module__}.{kind.__qualname__}")


def _plain_dict(value: dict[Any, Any], path: str) -> dict[Any, Any]:
    items = {}
    same = True
    for key, item in value.items():
        plain_key = as_plain_data(key, f"a key of {path or 'it'}")
        items[plain_key] = as_plain_data(item, f"{path}.{key}" if path else str(key))
        same = same and plain_key is key and items[plain_key] is item
    if same:
        return value
    # A copy and not a new dict, because state dicts of modules carry versions as an attribute.
    plain = copy.copy(value)
    plain.clear()
    plain.update(items)
    return plain
