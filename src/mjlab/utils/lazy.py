"""Lazy import of package attributes."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazy_names(module_name: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a module `__getattr__` that imports names from their modules (`homes`) on first use."""

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module_name!r} has no attribute {name!r}")
        try:
            module = importlib.import_module(homes[name])
        except AttributeError as error:
            # `from package import name` would hide the cause behind "cannot import name".
            raise ImportError(f"Import of {homes[name]} failed: {error}") from error
        return getattr(module, name)

    return __getattr__
