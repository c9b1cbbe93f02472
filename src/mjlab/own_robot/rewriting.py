"""Files of a written package, rewritten without loss of a user's edits.

The package keeps a record of the files as they were written (`new_robot.json`). A later run replaces
the files that are still the same, and writes `<file>.new` beside those that a user has edited.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mjlab.utils.errors import UserError
from mjlab.utils.os import write_atomically

RECORD = "new_robot.json"
Task = Literal["velocity", "reach", "tracking", "bare"]


@dataclass
class Record:
    """Origin of a package, and its files as written."""

    model: str = ""
    """Model, as given to the command."""
    task: Task | None = None
    """Task, as given to the command."""
    settings: dict[str, str] = field(default_factory=dict)
    """Answers of the user, by key."""
    files: dict[str, str] = field(default_factory=dict)
    """Hash of each file, by path in the package."""


def read_record(folder: Path) -> Record:
    """Return the record of a package; an empty one for a new or empty folder.

    Raises:
        UserError: the folder holds something else.
    """
    path = folder / RECORD
    if path.is_file():
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(
            f"--output {folder}: expected a new folder, or a package of new-robot (with {RECORD}), "
            "got other files; use another folder."
        )
    return Record()


def write_files(folder: Path, files: dict[str, bytes], record: Record) -> list[str]:
    """Write a package's files and its record; return the paths that were written as `<file>.new`.

    Args:
        folder: Package.
        files: Content by path in the package.
        record: Record to write; its files are those of the last time, and are updated.
    """
    kept = []
    edited = {name for name, content in files.items() if _is_edited(folder, name, content, record)}
    if any(name.endswith("/robot.py") for name in edited):
        # A task of other values than those of the kept robot would not fit it.
        edited |= {
            name
            for name, content in files.items()
            if name.endswith("/task.py") and _differs(folder / name, content)
        }
    for name, content in files.items():
        path = folder / name
        if name in edited:
            kept.append(name)
            path = path.with_name(path.name + ".new")
        else:
            record.files[name] = _hash(content)
        write_atomically(path, content)
    text = json.dumps(vars(record), indent=2, ensure_ascii=False) + "\n"
    write_atomically(folder / RECORD, text.encode())
    return kept


def _is_edited(folder: Path, name: str, content: bytes, record: Record) -> bool:
    """Return True if a user's edits of a file are neither those of the record nor the new content."""
    path = folder / name
    return _differs(path, content) and _hash(path.read_bytes()) != record.files.get(name)


def _differs(path: Path, content: bytes) -> bool:
    return path.is_file() and path.read_bytes() != content


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
