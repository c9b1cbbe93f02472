"""Configs as JSON from which they can be written again: classes, functions, and all fields.

    {"class": "mjlab.managers.reward_manager:RewardTermCfg",
     "func": "mjlab.envs.mdp.rewards:action_rate_l2", "params": {}, "weight": -0.1}

Functions and classes are "module:name", tuples are lists, a slice of everything is None, and a
mapping whose keys are not strings is {"items": [[key, value], ...]}.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from mjlab.utils.string import qualified_name
from mjlab.utils.tables import json_value


def config_json(value: Any) -> Any:
    """Return a config as JSON values, with all fields and the class of each dataclass."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: config_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": qualified_name(type(value)), **fields}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            return {"items": config_json(list(value.items()))}
        return {key: config_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [config_json(item) for item in value]
    if isinstance(value, functools.partial):
        parts = {"args": config_json(value.args), "keywords": config_json(value.keywords)}
        return {"partial": config_json(value.func), **parts}
    if isinstance(value, slice):
        return None
    return json_value(value.value if isinstance(value, enum.Enum) else value)


def signatures_json(*configs: Any) -> dict[str, Any]:
    """Return docstring and arguments of every function and class in `configs`, by "module:name".

    Arguments have a type, and a default unless they are required. The manager passes the first ones
    of a term: the environment and, to events and curricula, the ids of environments.
    """
    named = {qualified_name(one): one for config in configs for one in _callables(config)}
    return {
        name: {"doc": inspect.getdoc(named[name]) or "", "arguments": _arguments(named[name])}
        for name in sorted(named)
    }


def _callables(value: Any) -> Iterator[Any]:
    """Yield the functions in a config, and the classes of its dataclasses."""
    if isinstance(value, functools.partial):
        yield from _callables([value.func, value.args, value.keywords])
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield type(value)
        for field in dataclasses.fields(value):
            yield from _callables(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield from _callables(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _callables(item)
    elif callable(value):
        yield value


def _arguments(function: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(function):
        return {field.name: _field(field) for field in dataclasses.fields(function)}
    # The manager builds a term that is a class, and calls it.
    is_term = inspect.isclass(function) and "__call__" in vars(function)
    try:
        parameters = inspect.signature(function.__call__ if is_term else function).parameters
    except (TypeError, ValueError):
        # Written in C.
        return {}
    return {name: _parameter(one) for name, one in parameters.items() if name != "self"}


def _field(field: dataclasses.Field[Any]) -> dict[str, Any]:
    described = {"type": _type_name(field.type)}
    if field.default is not dataclasses.MISSING:
        described["default"] = config_json(field.default)
    elif field.default_factory is not dataclasses.MISSING:
        described["default"] = config_json(field.default_factory())
    return described


def _parameter(parameter: inspect.Parameter) -> dict[str, Any]:
    described = {}
    if parameter.annotation is not parameter.empty:
        described["type"] = _type_name(parameter.annotation)
    if parameter.default is not parameter.empty:
        described["default"] = config_json(parameter.default)
    return described


def _type_name(annotation: Any) -> str:
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
