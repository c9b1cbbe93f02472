"""Recursive package import, for task registration."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence


def import_packages(package_name: str, blacklist_pkgs: Sequence[str] | None = None) -> None:
    """Import a package and, recursively, its sub-packages (plain modules are not imported).

    Args:
        package_name: Dotted name of the package.
        blacklist_pkgs: Sub-packages to skip, with their descendants: those whose dotted name contains
            one of these strings.

    Import errors propagate.
    """
    blacklist = tuple(blacklist_pkgs or ())
    package = importlib.import_module(package_name)
    for info in pkgutil.iter_modules(getattr(package, "__path__", []), package.__name__ + "."):
        if info.ispkg and not any(word in info.name for word in blacklist):
            import_packages(info.name, blacklist)
