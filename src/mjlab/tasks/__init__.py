"""The tasks that ship with mjlab, one folder a family, and the registry that lists them all."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    if name == "import_packages":
        from mjlab.utils.lab_api.tasks.importer import import_packages

        return import_packages
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
