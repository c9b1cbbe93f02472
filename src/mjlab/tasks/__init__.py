"""Built-in tasks, one package per family, and the task registry."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "import_packages":
        from mjlab.utils.lab_api.tasks.importer import import_packages

        return import_packages
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
