"""Import of a package together with its sub-packages, so that their tasks register themselves."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence


def import_packages(package_name: str, blacklist_pkgs: Sequence[str] | None = None) -> None:
    """Import a package and, recursively, its sub-packages (plain modules are left alone).

    Args:
        package_name: Dotted name of the package.
        blacklist_pkgs: A sub-package whose dotted name contains one of these is left out, together
            with what lies below it.

    Errors raised while importing are passed on.
    """
    blacklist = tuple(blacklist_pkgs or ())
    package = importlib.import_module(package_name)
    for info in pkgutil.iter_modules(getattr(package, "__path__", []), package.__name__ + "."):
        if info.ispkg and not any(word in info.name for word in blacklist):
            import_packages(info.name, blacklist)
