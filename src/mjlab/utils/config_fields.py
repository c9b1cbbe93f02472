"""Attributes of configs that are not fields: an assignment such as `cfg.episode_lenght_s = 3`."""

import dataclasses
import difflib
import functools
import warnings
from collections.abc import Iterator, Mapping
from typing import Any


def check_fields_exist(owner: str, cfg: Any) -> None:
    """Warn, once, of public attributes that were set on mjlab's configs in `cfg` and are no fields."""
    if unknown := "; ".join(_unknown(owner, cfg, set())):
        _warn_once(f"Attributes that are not fields of their configs: {unknown}.")


def _unknown(path: str, value: Any, seen: set[int]) -> Iterator[str]:
    if id(value) in seen:
        return
    seen.add(id(value))
    inner: dict[str, Any] = {}
    if isinstance(value, (Mapping, list, tuple)):
        items = value.items() if isinstance(value, Mapping) else enumerate(value)
        inner = {f"{path}[{key!r}]": item for key, item in items}
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value)]
        inner = {f"{path}.{name}": getattr(value, name, None) for name in fields}
        is_ours = any(base.__module__.startswith("mjlab.") for base in type(value).__mro__)
        for name in getattr(value, "__dict__", {}) if is_ours else ():
            if not (name in fields or name.startswith("_") or hasattr(type(value), name)):
                close = difflib.get_close_matches(name, fields, n=1)
                yield f"{path}.{name}" + "".join(f" (did you mean {c!r}?)" for c in close)
    for name, item in inner.items():
        yield from _unknown(name, item, seen)


# Registry, environment and runner check the same config.
_warn_once = functools.cache(functools.partial(warnings.warn, category=UserWarning, stacklevel=3))
