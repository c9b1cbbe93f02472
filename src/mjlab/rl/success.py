"""What counts as a success, in words."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from typing import Any

from mjlab.rl.config import EvaluationCfg

_OPENING = re.compile(r"^Return (?:where|whether|if) ")
_SHAPE = re.compile(r",? \([^()]*,\)(?: bool)?\.?$")


def success_definition(cfg: EvaluationCfg) -> str | None:
    """Return what makes an episode a success, or None where the task does not say.

    Of a function that is the first line of its docstring, without what is said of the tensor.
    """
    if cfg.success_func is not None:
        return f"{_meaning(cfg.success_func)}, one step before the end"
    if cfg.success_is_survival:
        return "no termination ended the episode before its time was over"
    target = required_return(cfg)
    return None if target is None else f"return of at least {target:g}"


def required_return(cfg: EvaluationCfg) -> float | None:
    """Return from which return an episode is a success; None where the return does not decide."""
    if cfg.success_func is not None or cfg.success_is_survival:
        return None
    return cfg.solved_return if cfg.success_return is None else cfg.success_return


def _meaning(func: Callable[..., Any]) -> str:
    while isinstance(func, functools.partial):
        func = func.func
    name = getattr(func, "__name__", type(func).__name__)
    first_line = (inspect.getdoc(func) or "").split("\n")[0].strip()
    words = _OPENING.sub("", _SHAPE.sub("", first_line)).rstrip(".")
    return f"{words} ({name})" if words else name
