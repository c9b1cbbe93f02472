"""Finding motions: files, folders, and those that ship with the package."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from mjlab.tasks.tracking.motion_file import MotionFileError

SHIPPED = Path(__file__).parent / "motions"
"""Folder of the motions that ship with the package; a README there says what they are."""


# Commas that a path in a list may have; more are looked for in a single path only.
_MAX_COMMAS = 8


def shipped_motions() -> dict[str, Path]:
    """Return the motions that ship with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.npz"))}


def find_motions(text: str) -> list[Path]:
    """Return the files that `text` names: one or several, separated by commas.

    Each is a file, a folder (all `.npz` files in it, by name), or the name of a motion that ships
    with the package, such as `squat`. Commas within a path that exists separate nothing.

    Raises:
        MotionFileError: nothing is named, or one of them does not exist.
    """
    parts = [part for part in _parts_of(text) if part]
    if not parts:
        raise MotionFileError(
            "No motion is named. Give a file (--motion-file, or motion_file of the command), or "
            f"one that ships with the package: {', '.join(shipped_motions())}."
        )
    return [path for part in parts for path in _files_of(part)]


def _parts_of(text: str) -> list[str]:
    """Split `text` at commas, but not at those of a path that exists; the longest one is meant."""
    if _exists(text):
        return [text]
    pieces, parts = text.split(","), []
    while pieces:
        count = min(len(pieces), _MAX_COMMAS + 1)
        while count > 1 and not _exists(",".join(pieces[:count]).strip()):
            count -= 1
        parts.append(",".join(pieces[:count]).strip())
        pieces = pieces[count:]
    return parts


def _exists(path: str) -> bool:
    # Unlike `Path.exists`, which raises for a text too long for a path, as a long list is.
    return os.path.exists(os.path.expanduser(path))


def _files_of(part: str) -> list[Path]:
    path = Path(part).expanduser()
    if os.path.isdir(path):
        files = sorted(path.glob("*.npz"))
        if not files:
            raise MotionFileError(f"The folder {path} has no motion (.npz) in it.")
        return files
    shipped = shipped_motions()
    if not _exists(part) and part in shipped:
        return [shipped[part]]
    if not os.path.isfile(path):
        near = difflib.get_close_matches(part, shipped, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MotionFileError(
            f"There is no motion file {part!r}, and none that ships with the package is called "
            f"so.{hint} Those are: {', '.join(shipped) or 'none'}."
        )
    return [path]
