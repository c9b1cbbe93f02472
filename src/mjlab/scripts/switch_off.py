"""Switching terms and optional configs off from the command line:
`--env.rewards.smooth-reward None`, `--env.observations.actor.terms.joint-vel.noise None`.

A term or config that is None is off. tyro has no flag for a whole config inside another one, only
for its fields, so these flags are taken out of the command line before tyro reads it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

C = TypeVar("C")

# Fields that hold terms by name. Observation terms are below their group, as `terms`.
_TERM_DICTS = frozenset(
    (
        "observations",
        "terms",
        "actions",
        "rewards",
        "terminations",
        "events",
        "commands",
        "curriculum",
        "metrics",
        "recorders",
    )
)


def switch_terms_off(default: C, flags: list[str]) -> tuple[C, list[str]]:
    """Return `default` without the terms and configs `flags` set to None, and the remaining flags.

    All other flags remain, for tyro to judge. `default` itself is not modified.
    """
    config = copy.deepcopy(default)
    remaining: list[str] = []
    for flag, value, words in _flag_values(flags):
        holder, name = _term_at(config, flag) if value == "None" else (None, "")
        if holder is None:
            remaining += words
        elif isinstance(holder, dict):
            holder[name] = None
        else:
            setattr(holder, name, None)
    return config, remaining


def _flag_values(flags: list[str]) -> Iterator[tuple[str, str | None, list[str]]]:
    """Yield every flag with its value, and the words that it was made of.

    `--flag value` and `--flag=value` mean the same; values after the first are words of their own.
    """
    position = 0
    while position < len(flags):
        word = flags[position]
        flag, equals, value = word.partition("=")
        if equals:
            yield flag, value, [word]
        elif word.startswith("--") and flags[position + 1 : position + 2] == ["None"]:
            yield word, "None", [word, "None"]
            position += 1
        else:
            yield word, None, [word]
        position += 1


def _term_at(config: Any, flag: str) -> tuple[Any, str]:
    """Return the dict or config that holds what `flag` names, and its key; (None, "") if none does."""
    if not flag.startswith("--"):
        return None, ""
    holder: Any = None
    value, key, inside = config, "", ""
    for part in flag.removeprefix("--").split("."):
        inside, holder = key, value
        if holder is None:
            return None, ""
        names = list(holder) if isinstance(holder, Mapping) else list(vars(holder))
        matching = [name for name in names if _spelled_alike(name, part)]
        if not matching:
            return None, ""
        key = matching[0]
        value = holder[key] if isinstance(holder, Mapping) else getattr(holder, key)
        if not is_dataclass(value) and not isinstance(value, Mapping | None):
            return None, ""
    is_term = isinstance(holder, dict) and inside in _TERM_DICTS
    return (holder, key) if is_term or _may_be_none(holder, key) else (None, "")


def _may_be_none(holder: Any, key: str) -> bool:
    """Return True if field `key` of a config is declared as a config, or a dict of one, or None."""
    if not is_dataclass(holder):
        return False
    try:
        options = get_args(get_type_hints(type(holder)).get(key))
    except NameError:
        # A class annotated with names that only type checkers import says nothing here.
        return False
    return NoneType in options and any(
        is_dataclass(option) or get_origin(option) is dict for option in options
    )


def _spelled_alike(name: Any, part: str) -> bool:
    # tyro writes `smooth_reward` as `smooth-reward` and takes both.
    return isinstance(name, str) and name.replace("_", "-") == part.replace("_", "-")
