"""Comparison of task configs with tables of their parameters, term for term.

A table is a YAML file with the entries `task`, `env`, `rl` and `play_differs`. It names the class
of a config as `_`, functions as `module:name` below `mjlab`, and leaves out what equals the
default of its field. `play_differs` lists, by path, the deviations of the play config.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

FIGURES = Path(__file__).parent / "figures"
REMOVED = "(removed or default)"


def tables() -> dict[str, dict[str, Any]]:
    """Return all tables by task name."""
    loaded = [yaml.safe_load(path.read_text()) for path in sorted(FIGURES.glob("*.yaml"))]
    return {table["task"]: table for table in loaded}


def differences(table: dict[str, Any]) -> list[str]:
    """Return the differences between the registered task and its table, one line each."""
    task = table["task"]
    env, rl = load_env_cfg(task), load_rl_cfg(task)
    found = [f"env.{line}" for line in _compare(table["env"], figures_of(env))]
    found += [f"rl.{line}" for line in _compare(table["rl"], figures_of(rl))]
    play = _flat(figures_of(load_env_cfg(task, play=True)))
    found += [f"play: {line}" for line in _compare_play(table, _flat(figures_of(env)), play)]
    return found


def figures_of(value: Any) -> Any:
    """Return a config in the format of tables: plain values, without defaults."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _figures_of_dataclass(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, Mapping):
        # A term that is None is disabled and equals a missing one. Tables store integer keys as text.
        return {str(key): figures_of(item) for key, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [figures_of(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(figures_of(item) for item in value)
    if callable(value):
        return _function_name(value)
    return value


def _figures_of_dataclass(value: Any) -> dict[str, Any]:
    result: dict[str, Any] = {"_": type(value).__name__}
    parameters = inspect.signature(type(value)).parameters
    for field in dataclasses.fields(value):
        current = getattr(value, field.name)
        figures = figures_of(current)
        # Some required fields have a default for packages of earlier releases.
        required = field.init and parameters[field.name].default is inspect.Parameter.empty
        is_default = not required and _is_default(field, figures)
        if not is_default and not field.name.startswith("_"):
            result[field.name] = figures
    return result


def _is_default(field: dataclasses.Field, figures: Any) -> bool:
    if field.default is not dataclasses.MISSING:
        default = field.default
    elif field.default_factory is not dataclasses.MISSING:
        default = field.default_factory()
    else:
        return False
    return _same(figures_of(default), figures)


def _function_name(function: Any) -> str:
    name = f"{function.__module__}:{function.__qualname__}"
    return name.removeprefix("mjlab.")


def _same(expected: Any, found: Any) -> bool:
    if isinstance(expected, bool) or isinstance(found, bool):
        return expected is found
    if isinstance(expected, (int, float)) and isinstance(found, (int, float)):
        # Tables print ten digits.
        return math.isclose(expected, found, rel_tol=1e-9, abs_tol=1e-12)
    if isinstance(expected, str) and isinstance(found, str):
        return expected == found or _both_functions(expected, found)
    if isinstance(expected, list) and isinstance(found, list):
        return len(expected) == len(found) and all(map(_same, expected, found))
    if isinstance(expected, dict) and isinstance(found, dict):
        return expected.keys() == found.keys() and all(
            _same(expected[key], found[key]) for key in expected
        )
    return expected == found


def _both_functions(expected: str, found: str) -> bool:
    """Return True if two names may refer to the same function.

    Lambdas have no other identity. The module that defines a function may differ as long as the public
    path leads to the same function.
    """
    if ":" not in expected or ":" not in found:
        return False
    if "<lambda>" in expected:
        return "<lambda>" in found
    module, _, name = expected.partition(":")
    try:
        public = getattr(__import__(f"mjlab.{module}", fromlist=[name]), name)
    except (ImportError, AttributeError):
        return False
    return _function_name(public) == found


def _compare(expected: Any, found: Any, path: str = "") -> list[str]:
    """Return the paths of differing values, with both values."""
    if isinstance(expected, dict) and isinstance(found, dict):
        lines: list[str] = []
        for key in [*expected, *(key for key in found if key not in expected)]:
            inner = f"{path}.{key}" if path else str(key)
            if key not in found and not _is_lambda(expected[key]):
                lines.append(f"{inner} is {expected[key]!r} in the table, and default here")
            elif key not in expected:
                lines.append(f"{inner} is default in the table, and {found[key]!r} here")
            elif key in found:
                lines += _compare(expected[key], found[key], inner)
        return lines
    if isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found):
        pairs = enumerate(zip(expected, found, strict=True))
        return [line for i, (a, b) in pairs for line in _compare(a, b, f"{path}[{i}]")]
    return (
        [] if _same(expected, found) else [f"{path} is {expected!r} in the table, {found!r} here"]
    )


def _is_lambda(value: Any) -> bool:
    # Two lambdas from one default are never equal, so a table cannot tell that one is default.
    return isinstance(value, str) and "<lambda>" in value


def _flat(figures: Any, path: str = "") -> dict[str, Any]:
    """Return every value by its path, and every dict too, so that a removed term has one path."""
    result = {path: figures} if path else {}
    if isinstance(figures, dict):
        for key, value in figures.items():
            result |= _flat(value, f"{path}.{key}" if path else str(key))
    return result


def _compare_play(table: dict[str, Any], train: dict, play: dict) -> list[str]:
    """Return unexpected differences between the play config and the training config."""
    stated: dict[str, Any] = table["play_differs"]
    lines = []
    for path, expected in stated.items():
        if expected == REMOVED:
            if path in play:
                lines.append(f"{path} should be removed or default, and is {play[path]!r}")
        elif path not in play or not _same(expected, play[path]):
            lines.append(f"{path} should be {expected!r}, and is {play.get(path, 'default')!r}")
    for path in sorted({*train, *play}):
        covered = any(path == s or path.startswith(f"{s}.") for s in stated)
        # A dict that holds a stated difference differs too.
        above = any(s.startswith(f"{path}.") for s in stated)
        if not covered and not above and not _same(train.get(path), play.get(path)):
            lines.append(f"{path} is {train.get(path)!r} in training, {play.get(path)!r} in play")
    return lines
