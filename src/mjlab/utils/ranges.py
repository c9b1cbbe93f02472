"""Ranges of numbers, beside the fields of configs: `gamma: Annotated[float, Range(0.0, 1.0)] = 0.99`.

Commands check them once, before they build anything (`check_ranges`). A field that a subclass defines
again keeps its range.
"""

from __future__ import annotations

import contextlib
import functools
import math
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from typing import Annotated, Any, Literal, get_args, get_type_hints


@dataclass(frozen=True)
class Range:
    """Numbers that make sense in a field, or in every item of a sequence or dict. NaN never does.

    Values that are not numbers, such as None, are not judged. True is 1.
    """

    low: float = -math.inf
    """Lower bound. If it is an integer, so are all numbers of the range."""
    high: float = math.inf
    """Upper bound."""
    ends: Literal["[]", "(]", "[)", "()"] = "[]"
    """Brackets of the interval: a round one excludes its bound."""

    def __contains__(self, number: Any) -> bool:
        is_kind = isinstance(number, Integral) or not isinstance(self.low, int)
        is_above = self.low < number if self.ends[0] == "(" else self.low <= number
        is_below = number < self.high if self.ends[1] == ")" else number <= self.high
        return bool(is_kind and is_above and is_below)

    def __str__(self) -> str:
        bounds = f"{self.low:.10g}, {self.high:.10g}"
        if self.high != math.inf:
            limits = f" in {self.ends[0]}{bounds}{self.ends[1]}"
        else:
            limits = f" {'>' if self.ends[0] == '(' else '>='} {self.low:.10g}"
            limits = "" if self.low == -math.inf else limits
        is_finite = self.high == math.inf and self.ends[1] == ")"
        kind = "an integer" if isinstance(self.low, int) else "a number"
        kind = "a finite number" if is_finite and kind == "a number" else kind
        return f"{kind}{limits}"


Count = Annotated[int, Range(1)]
"""Number of something."""
CountOrZero = Annotated[int, Range(0)]
"""Number of something, or none of it."""
Positive = Annotated[float, Range(0.0, ends="()")]
"""Finite number above zero."""
Limit = Annotated[float, Range(0.0, ends="(]")]
"""Number above zero; infinite: no limit."""
Weight = Annotated[float, Range(0.0, ends="[)")]
"""Finite number, at least zero."""
Fraction = Annotated[float, Range(0.0, 1.0)]
"""Number from zero to one."""
Number = Annotated[float, Range()]
"""Number other than NaN."""
Seed = Annotated[int, Range(0, 2**32 - 1)]
"""Seed of random number generators."""


def check_ranges(cfg: Any, typed: Collection[str], path: str = "") -> None:
    """Check the numbers of a config: raise for one that was typed, and warn of each other.

    Releases 1.x run what the config of a task says.

    Args:
        cfg: Config, or flags of a command.
        typed: Paths of the settings that were typed, such as `agent.algorithm.gamma`, or of configs that
            hold them.
        path: Path of `cfg`; empty for the flags of a command.

    Raises:
        ValueError: a number out of its range was typed, or is 0 where a count is expected.
    """
    found = list(out_of_range(cfg, path))
    for name, limits, value in found:
        problem = f"expected {limits}, got {value}."
        parts = name.removeprefix("options.").split(".")
        if any(".".join(parts[:n]) in typed for n in range(1, len(parts) + 1)):
            raise ValueError(f"--{'.'.join(parts).replace('_', '-')}: {problem}")
        # Releases 1.x raise during training.
        if limits == Range(1) and value == 0:
            raise ValueError(f"{name}: {problem}")
    for name, limits, value in found:
        warnings.warn(f"{name}: expected {limits}, got {value}.", UserWarning, stacklevel=2)


def out_of_range(
    cfg: Any, path: str = "", above: tuple[int, ...] = ()
) -> Iterator[tuple[str, Range, Any]]:
    """Yield path, range and value of each number out of its range, in depth.

    `above` are the ids of the configs that hold `cfg`, in case it holds one of them.
    """
    if id(cfg) in above:
        return
    prefix = f"{path}." if path else ""
    for name, value in _entries(cfg).items():
        inner, limits = f"{prefix}{name}", _ranges(type(cfg)).get(name)
        if limits is None:
            yield from out_of_range(value, inner, (*above, id(cfg)))
        elif isinstance(value, Mapping):
            for key, item in value.items():
                if not all(number in limits for number in _numbers(item)):
                    yield f"{inner}.{key}", limits, item
        elif not all(number in limits for number in _numbers(value)):
            yield inner, limits, value


def _entries(cfg: Any) -> dict[Any, Any]:
    if is_dataclass(cfg) and not isinstance(cfg, type):
        return {field.name: getattr(cfg, field.name, None) for field in fields(cfg)}
    if isinstance(cfg, Mapping):
        return dict(cfg)
    return dict(enumerate(cfg)) if isinstance(cfg, (list, tuple)) else {}


def _numbers(value: Any) -> Iterator[Real]:
    if isinstance(value, Real):
        yield value
    for item in value if isinstance(value, (list, tuple)) else ():
        yield from _numbers(item)


# Cached: 0.03 s instead of 0.75 s for the configs of a velocity task.
@functools.cache
def _ranges(kind: type) -> dict[str, Range]:
    """Return the ranges of the fields of a class: of each, that of the most derived class with one."""
    found: dict[str, Range] = {}
    for base in reversed(kind.__mro__ if is_dataclass(kind) else ()):
        # Annotations of other packages may be for type checkers alone.
        with contextlib.suppress(NameError, AttributeError, TypeError, SyntaxError):
            hints = get_type_hints(base, include_extras=True)
            found |= {name: own[0] for name, hint in hints.items() if (own := [*_in_hint(hint)])}
    return found


def _in_hint(hint: Any) -> Iterator[Range]:
    if isinstance(hint, Range):
        yield hint
    for part in get_args(hint):
        yield from _in_hint(part)
