"""The motions that a run was trained on, kept in its folder: copies, where they came from, hashes.

<run>/motion/motions.json   [{"file": "squat.npz", "source": "...", "sha256": "..."}, ...]
<run>/motion/squat.npz      the copies, in that order
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjlab.tasks.tracking.motion_file import MotionFileError, motion_hash

FOLDER = "motion"
"""Name of the folder, in that of the run."""
INDEX = "motions.json"
"""Name of the list, in the folder."""


def record_motions(
    files: Sequence[Path], run_dir: Path, registry_name: str | None = None
) -> list[Path]:
    """Copy motions into the folder of a run, and say where they came from; return what is new.

    Args:
        files: The motions, in order.
        run_dir: Folder of the run. What it holds already stays as it is.
        registry_name: The Weights & Biases artifact that they come from.
    """
    folder = run_dir / FOLDER
    if (folder / INDEX).is_file():
        return []
    folder.mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = []
    for path in files:
        name = _free_name(path.name, [entry["file"] for entry in entries])
        # Runs that go on from another one take their motions from that one's folder.
        shutil.copyfile(path, folder / name)
        source = registry_name if registry_name is not None else str(path.resolve())
        entries.append({"file": name, "source": source, "sha256": motion_hash(folder / name)})
    temporary = folder / f".{INDEX}.tmp"
    temporary.write_text(json.dumps(entries, indent=2) + "\n")
    # Last, because its presence says that all the others are there.
    temporary.replace(folder / INDEX)
    return [*(folder / entry["file"] for entry in entries), folder / INDEX]


def recorded_motions(run_dir: Path) -> list[Path]:
    """Return the motions that a run was trained on, in order; none where it recorded none.

    Raises:
        MotionFileError: the record is damaged, or a copy is not what was recorded.
    """
    index = run_dir / FOLDER / INDEX
    if not index.is_file():
        return []
    try:
        entries = json.loads(index.read_text())
        listed = [(Path(str(entry["file"])).name, str(entry["sha256"])) for entry in entries]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MotionFileError(
            f"{index} is damaged ({error}). Name the motion with --motion-file."
        ) from error
    paths = []
    for name, expected in listed:
        path = run_dir / FOLDER / name
        if not path.is_file() or motion_hash(path) != expected:
            raise MotionFileError(
                f"The run in {run_dir} was trained on a motion whose copy {path} is missing or was "
                "changed since. Name the motion with --motion-file."
            )
        paths.append(path)
    return paths


def _free_name(name: str, taken: list[str]) -> str:
    stem, number = Path(name).stem, 2
    while name in taken:
        name, number = f"{stem}-{number}.npz", number + 1
    return name
