"""Strict name matching by regular expression, and string conversions.

Every pattern must match a whole name (`re.fullmatch`), and mismatches raise. For lenient matching,
see `mjlab.utils.string`.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

from mjlab.utils.errors import WrongTypeError, check_one_of
from mjlab.utils.string import compile_pattern, qualified_name


def resolve_matching_names(
    keys: str | Sequence[str],
    list_of_strings: Sequence[str],
    preserve_order: bool = False,
) -> tuple[list[int], list[str]]:
    """Return indices and names of matches.

    Args:
        keys: One or several regular expressions. An empty sequence selects nothing.
        list_of_strings: Candidate names.
        preserve_order: Group matches by pattern, in the order of `keys`, and in name order within
            each group. False: name order.

    Raises `ValueError` if a pattern matches no name, or two patterns match one name.
    """
    keys = [keys] if isinstance(keys, str) else list(keys)
    owners = _match_names(keys, list_of_strings)
    indices = [index for index, owner in enumerate(owners) if owner is not None]
    if preserve_order:
        # `sorted` is stable, so names stay in order within a group.
        indices = sorted(indices, key=lambda index: owners[index] or 0)
    return indices, [list_of_strings[index] for index in indices]


def resolve_matching_names_values(
    data: dict[str, Any], list_of_strings: Sequence[str], preserve_order: bool = False
) -> tuple[list[int], list[str], list[Any]]:
    """Return indices, names and values of the names matched by the keys of `data`.

    Keys are regular expressions, matched as in `resolve_matching_names`. Raises `TypeError` if `data`
    is not a dict, and `ValueError` as `resolve_matching_names`.
    """
    if not isinstance(data, dict):
        raise WrongTypeError(
            f"Expected a dict of regular expression to value, got {type(data).__name__}: {data!r}."
        )
    indices, names = resolve_matching_names(list(data), list_of_strings, preserve_order)
    owners = _match_names(list(data), list_of_strings)
    values = list(data.values())
    return indices, names, [values[owners[index] or 0] for index in indices]


def _match_names(keys: Sequence[str], names: Sequence[str]) -> list[int | None]:
    """Return the index of the matching key for each name, or None."""
    patterns = [compile_pattern(key) for key in keys]
    owners = [[i for i, pattern in enumerate(patterns) if pattern.fullmatch(n)] for n in names]
    unmatched = sorted(set(range(len(keys))).difference(*owners))
    several = next((k for k, own in enumerate(owners) if len(own) > 1), None)
    if several is not None:
        problem = (
            f"The name {names[several]!r} is matched by several patterns: "
            f"{[keys[i] for i in owners[several]]}. Each name may be matched by one pattern only."
        )
    elif unmatched:
        problem = (
            f"These patterns match no name: {[keys[i] for i in unmatched]}. A pattern must match a "
            "whole name."
        )
    else:
        return [own[0] if own else None for own in owners]
    lines = [f"\n  {key!r}: {[n for n in names if re.fullmatch(key, n)]}" for key in keys]
    raise ValueError(f"{problem}\nMatches:{''.join(lines)}\nAvailable names: {list(names)}")


def to_camel_case(snake_str: str, to: str = "cC") -> str:
    """Convert `snake_case` to `camelCase` ("cC") or `CamelCase` ("CC").

    Raises `ValueError` for an unknown `to`.
    """
    check_one_of("to", to, ("cC", "CC"))
    first, *rest = snake_str.split("_")
    head = first if to == "cC" else first[:1].upper() + first[1:]
    return head + "".join(word[:1].upper() + word[1:] for word in rest)


def to_snake_case(camel_str: str) -> str:
    """Convert `CamelCase` to `snake_case`. Consecutive capitals are one word."""
    words = re.sub(r"([A-Z]+)([A-Z][a-z])", r"\1_\2", camel_str)
    return re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", words).lower()


def string_to_slice(s: str) -> slice:
    """Convert the string form of a slice, such as "slice(0, 3, None)", to a slice.

    Raises `ValueError` for other strings.
    """
    match = re.fullmatch(r"slice\((.*)\)", s.strip())
    parts = [part.strip() for part in match.group(1).split(",")] if match else []
    if not 1 <= len(parts) <= 3 or any(not re.fullmatch(r"None|-?\d+", part) for part in parts):
        raise ValueError(f"Expected a slice such as 'slice(0, 3, None)', got {s!r}.")
    return slice(*(None if part == "None" else int(part) for part in parts))


def is_lambda_expression(name: str) -> bool:
    """Return True if the string is the source of a lambda expression."""
    try:
        parsed = ast.parse(name.strip(), mode="eval")
    except (SyntaxError, ValueError):
        return False
    return isinstance(parsed.body, ast.Lambda)


def callable_to_string(value: Callable) -> str:
    """Return "module:qualified.name" of a callable, or the source of a lambda.

    Raises `ValueError` if the value is not callable, or if the source of a lambda is not found.
    """
    if not callable(value):
        raise ValueError(f"Expected a callable, got {type(value).__name__}: {value!r}.")
    if getattr(value, "__name__", "") != "<lambda>":
        return qualified_name(value)
    try:
        # A lambda inside a call or dict is not a complete statement: take the text from "lambda"
        # and drop characters at the end until the rest is one expression.
        text = inspect.getsource(value).strip()
    except (OSError, TypeError) as error:
        raise ValueError(f"Source of lambda {value!r} not found.") from error
    if text.count("lambda") == 1:
        text = text[text.index("lambda") :]
        for end in range(len(text), 0, -1):
            if is_lambda_expression(text[:end]):
                return text[:end].strip()
    raise ValueError(
        f"Source of {value!r} is ambiguous; use a named function, or a lambda on a separate line."
    )


def string_to_callable(name: str) -> Callable:
    """Return the callable for "module:qualified.name" or for the source of a lambda.

    Lambdas are evaluated: pass only trusted strings. Raises `ValueError` if the string has neither
    form, or if the named object does not exist or is not callable.
    """
    if is_lambda_expression(name):
        return eval(name.strip())
    module_name, separator, attribute = name.partition(":")
    if not separator or not module_name or not attribute:
        raise ValueError(f"Expected 'module:name' or a lambda, got {name!r}.")
    try:
        found: Any = importlib.import_module(module_name)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"Callable {name!r} not found: {error}.") from error
    if not callable(found):
        kind = type(found).__name__
        raise ValueError(f"{name!r}: expected a callable, got {kind}.")
    return found
