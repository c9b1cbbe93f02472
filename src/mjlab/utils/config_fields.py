"""Attributes of configs that are not fields: an assignment such as `cfg.episode_lenght_s = 3`.

Python accepts the assignment, and nothing reads the attribute.
"""

from __future__ import annotations

import dataclasses
import difflib
import dis
import functools
import inspect
import warnings
from collections.abc import Iterator, Mapping
from types import CodeType
from typing import Any

# Similarity of a misspelled name to its field: "wieght" and "weight" have 0.83.
_CLOSE = 0.8
_DIGITS = "0123456789_"


def check_fields_exist(owner: str, cfg: Any) -> None:
    """Check that attributes set on a config, and on the configs in it, are fields.

    Attributes with a leading underscore, class attributes, and attributes named in a method of the
    class are allowed, and so are attributes of dataclasses unrelated to mjlab's.

    Args:
        owner: Name of the config, for messages.
        cfg: Config: a dataclass with nested dataclasses, dicts, lists and tuples.

    Raises:
        ValueError: an attribute has a name close to a field's. Other attributes are reported in one
            `UserWarning`, because task packages may read attributes of their own.
    """
    unknown = []
    for path, part in _configs(owner, cfg, set()):
        fields = [field.name for field in dataclasses.fields(part)]
        assigned = _names_in_methods(type(part), reads=False)
        for name in (name for name in _attributes(part) if name not in fields):
            close = _misspelled(name, fields)
            # A class may assign `self.motion_files` beside a field `motion_file`.
            if name in assigned:
                close = [field for field in close if field.rstrip("s") != name.rstrip("s")]
            if close:
                raise ValueError(
                    f"{path}.{name}: {type(part).__name__} has no such field; did you mean "
                    f"{' or '.join(map(repr, close))}?"
                )
            if name not in assigned:
                unknown.append(f"{path}.{name} ({type(part).__name__})")
    if unknown:
        _warn_once(
            f"Attributes that are not fields of their configs, and that mjlab does not read: "
            f"{', '.join(unknown)}."
        )


@functools.cache
def _warn_once(message: str) -> None:
    """Warn, once per process: registry, environment and runner check the same config."""
    warnings.warn(message, UserWarning, stacklevel=3)


def _configs(path: str, value: Any, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """Yield path and value of each config in `value` that derives from a config of mjlab."""
    if id(value) in seen:
        return
    if isinstance(value, Mapping):
        inner = [(f"{path}[{key!r}]", item) for key, item in value.items()]
    elif isinstance(value, (list, tuple)):
        inner = [(f"{path}[{index}]", item) for index, item in enumerate(value)]
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = [
            (f"{path}.{field.name}", getattr(value, field.name, None))
            for field in dataclasses.fields(value)
        ]
        if any(
            base.__module__.startswith("mjlab.") and dataclasses.is_dataclass(base)
            for base in type(value).__mro__
        ):
            yield path, value
    else:
        return
    seen.add(id(value))
    for name, item in inner:
        yield from _configs(name, item, seen)


def _attributes(cfg: Any) -> list[str]:
    """Return the public attributes of an instance that neither its class has nor a method of it reads."""
    names = [name for name in getattr(cfg, "__dict__", ()) if not name.startswith("_")]
    names = [name for name in names if not hasattr(type(cfg), name)]
    fields = {field.name for field in dataclasses.fields(cfg)}
    if fields.issuperset(names):
        return []
    return [name for name in names if name not in _names_in_methods(type(cfg), reads=True)]


def _misspelled(name: str, fields: list[str]) -> list[str]:
    """Return the fields that `name` may misspell."""
    # `seed2` beside `seed` is numbered, and `my_events` beside `events` another name.
    words = set(name.split("_"))
    others = [
        field
        for field in fields
        if field.rstrip(_DIGITS) != name.rstrip(_DIGITS) and not set(field.split("_")) < words
    ]
    return difflib.get_close_matches(name, others, cutoff=_CLOSE)


def _names_in_methods(cls: type, reads: bool) -> set[str]:
    """Return the attribute names and strings that the methods of a class read, or else those assigned."""
    methods = [inspect.unwrap(method) for base in cls.__mro__ for method in _functions(base)]
    return {
        name
        for method in methods
        for name, is_stored in _names_in(method.__code__)
        if is_stored != reads
    }


def _functions(cls: type) -> Iterator[Any]:
    for member in vars(cls).values():
        function = getattr(member, "fget", None) or getattr(member, "__func__", None) or member
        if inspect.isfunction(function):
            yield function


def _names_in(code: CodeType) -> Iterator[tuple[str, bool]]:
    """Yield attribute names and strings in the code of a function, and True for assigned ones."""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "STORE_ATTR":
            yield instruction.argval, True
        elif instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            yield instruction.argval, False
    for constant in code.co_consts:
        if isinstance(constant, str):
            yield constant, False
        elif isinstance(constant, CodeType):
            yield from _names_in(constant)
