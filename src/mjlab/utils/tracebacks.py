"""Tracebacks, shortened to the lines of users' code."""

from __future__ import annotations

import sysconfig
import traceback
from pathlib import Path

TASK_PACKAGES = "mjlab.tasks"
"""Group of the entry points of packages that register tasks."""

_OWN = Path(__file__).parents[1]
# Folders of installed packages.
_INSTALLED = ("site-packages", "dist-packages")


def users_lines(error: BaseException) -> str:
    """Return the traceback of `error`, without its message, shortened to lines of users' code.

    Users' code is all but Python, this package and installed packages; of those, packages that register
    tasks count as well. If `error` was raised from others, the first with such lines is shown. Empty if
    there is none.
    """
    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in chain:
        chain.append(cause)
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    for cause in reversed(chain):
        lines = [
            line for line in traceback.extract_tb(cause.__traceback__) if _is_users(line.filename)
        ]
        if lines:
            text = "".join(traceback.format_list(lines))
            return f"Traceback (most recent call last):\n{text}"
    return ""


def _is_users(filename: str) -> bool:
    path = Path(filename)
    # Code without a file, such as `<string>` of dataclasses.
    if not path.is_absolute() or path.is_relative_to(_OWN):
        return False
    folders = [i for i, part in enumerate(path.parts) if part in _INSTALLED]
    if folders:
        from importlib.metadata import entry_points

        package = path.parts[folders[-1] + 1].removesuffix(".py")
        return package in {
            one.module.partition(".")[0] for one in entry_points(group=TASK_PACKAGES)
        }
    places = sysconfig.get_paths()
    return not any(
        path.is_relative_to(places[name]) for name in ("stdlib", "platstdlib", "scripts")
    )
