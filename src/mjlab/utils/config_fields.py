"""Attributes of configs that are not fields: an assignment such as `cfg.episode_lenght_s = 3`."""

import dataclasses
import difflib
import functools
import warnings
from collections.abc import Iterator
from typing import Any

from mjlab.compat import suggested_field


def check_fields_exist(owner: str, cfg: Any) -> None:
    """Warn, once, of public attributes that were set on mjlab's configs in `cfg` and are no fields."""
    if unknown := "; ".join(_unknown(owner, cfg, set())):
        _warn_once(f"Attributes that are not fields of their configs: {unknown}.")


def _unknown(path: str, value: Any, seen: set[int]) -> Iterator[str]:
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, (dict, list, tuple)):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _unknown(f"{path}[{key!r}]", item, seen)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value)]
        is_ours = any(base.__module__.startswith("mjlab.") for base in type(value).__mro__)
        for name, item in getattr(value, "__dict__", {}).items():
            if name in fields:
                yield from _unknown(f"{path}.{name}", item, seen)
            elif is_ours and not name.startswith("_") and not hasattr(type(value), name):
                today = suggested_field(type(value), name)
                close = [today] if today else difflib.get_close_matches(name, fields, n=1)
                yield f"{path}.{name}" + "".join(f" (did you mean {c!r}?)" for c in close)


# Registry, environment and runner check the same config.
_warn_once = functools.cache(functools.partial(warnings.warn, category=UserWarning, stacklevel=3))
