"""Finding motions: files, folders, and those that ship with the package."""

from __future__ import annotations

import difflib
from pathlib import Path

from mjlab.tasks.tracking.motion_file import MotionFileError

SHIPPED = Path(__file__).parent / "motions"
"""Folder of the motions that ship with the package; a README there says what they are."""


def shipped_motions() -> dict[str, Path]:
    """Return the motions that ship with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.npz"))}


def find_motions(text: str) -> list[Path]:
    """Return the files that `text` names: one or several, separated by commas.

    Each is a file, a folder (all `.npz` files in it, by name), or the name of a motion that ships
    with the package, such as `squat`.

    Raises:
        MotionFileError: nothing is named, or one of them does not exist.
    """
    # A path that exists is meant, even if there are commas in it.
    parts = [text] if text and Path(text).exists() else [part.strip() for part in text.split(",")]
    parts = [part for part in parts if part]
    if not parts:
        raise MotionFileError(
            "No motion is named. Give a file (--motion-file, or motion_file of the command), or "
            f"one that ships with the package: {', '.join(shipped_motions())}."
        )
    return [path for part in parts for path in _files_of(part)]


def _files_of(part: str) -> list[Path]:
    path = Path(part).expanduser()
    if path.is_dir():
        files = sorted(path.glob("*.npz"))
        if not files:
            raise MotionFileError(f"The folder {path} has no motion (.npz) in it.")
        return files
    shipped = shipped_motions()
    if not path.exists() and part in shipped:
        return [shipped[part]]
    if not path.is_file():
        near = difflib.get_close_matches(part, shipped, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise MotionFileError(
            f"There is no motion file {part!r}, and none that ships with the package is called "
            f"so.{hint} Those are: {', '.join(shipped) or 'none'}."
        )
    return [path]
