"""Files of a written package, rewritten without loss of a user's edits.

The package keeps a record of the files as they were written (`new_robot.json`). A later run replaces
the files that are still the same, and writes `<file>.new` beside those that a user has edited. Tests, README
and project file that a user has deleted do not come back.
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
    motion: str | None = None
    """Motion file of the task `tracking`, as given to the command."""
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

    Raises:
        UserError: a `<file>.new` of an earlier run has been edited. Nothing is written.
    """
    gone = deleted_files(folder, record)
    files = {name: content for name, content in files.items() if name not in gone}
    edited = {name for name, content in files.items() if _is_edited(folder, name, content, record)}
    if any(name.endswith("/robot.py") for name in edited):
        # A task, or a table, of other values than those of the kept robot would not fit it.
        edited |= {
            name
            for name, content in files.items()
            if (name.endswith("/task.py") or name == "README.md")
            and _differs(folder / name, content)
        }
    written = {f"{name}.new" if name in edited else name: files[name] for name in files}
    for name, content in written.items():
        if name not in files and _is_edited(folder, name, content, record):
            raise UserError(
                f"{folder / name}: edited by you, and a new one is to be written; merge it into "
                f"{name.removesuffix('.new')} and delete it. Nothing was written."
            )
    for name, content in written.items():
        record.files[name] = _hash(content)
        write_atomically(folder / name, content)
    text = json.dumps(vars(record), indent=2, ensure_ascii=False) + "\n"
    write_atomically(folder / RECORD, text.encode())
    return [name for name in files if name in edited]


def deleted_files(folder: Path, record: Record) -> list[str]:
    """Return the files of the record outside `src` that the user has deleted."""
    return [
        name
        for name in record.files
        if not name.startswith("src/")
        and not name.endswith(".new")
        and not (folder / name).exists()
    ]


def _is_edited(folder: Path, name: str, content: bytes, record: Record) -> bool:
    """Return True if a user's edits of a file are neither those of the record nor the new content."""
    path = folder / name
    return _differs(path, content) and _hash(path.read_bytes()) != record.files.get(name)


def _differs(path: Path, content: bytes) -> bool:
    return path.is_file() and path.read_bytes() != content


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
