"""Sources of motions: files, folders, bundled motions, Weights & Biases, run folders.

A run folder contains the training motions: copies, their sources, and hashes.

    <run>/motion/motions.json   [{"file": "squat.npz", "source": "...", "sha256": "..."}, ...]
    <run>/motion/squat.npz      copies, listed in order in motions.json
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjlab.tasks.tracking.motion_file import MotionFileError, motion_hash
from mjlab.utils.os import inside, own_folder, replacing
from mjlab.utils.string import suggest
from mjlab.utils.wandb import asking_wandb

FOLDER = "motion"
"""Name of the motion folder in the run folder."""
INDEX = "motions.json"
"""Name of the index file in the motion folder."""
_ARTIFACT_TYPE = "motions"
_ARTIFACT_FILE = "motion.npz"
_DEFAULT_ALIAS = "latest"
SHIPPED = Path(__file__).parent / "motions"
"""Folder of the bundled motions, described in its README."""
# Maximum number of commas in a path of a list. A single path may contain any number.
_MAX_COMMAS = 8


def find_motions(text: str) -> list[Path]:
    """Return the files of one or several motions, separated by commas in `text`.

    Each motion is a file, a folder (all `.npz` files in it, by name), or the name of a bundled
    motion such as `squat`. Commas within an existing path do not separate.

    Raises:
        MotionFileError: `text` is empty, or a motion is not found.
    """
    shipped, files = shipped_motions(), []
    for part in filter(None, _parts_of(text)):
        path = Path(part).expanduser()
        found = sorted(path.glob("*.npz")) if os.path.isdir(path) else [path]
        if not found:
            raise MotionFileError(f"Folder {path}: expected motions (.npz), got none.")
        if not os.path.exists(path):
            if part not in shipped:
                raise MotionFileError(
                    f"Unknown motion {part!r}; use a file, a folder with motions (.npz), or a "
                    f"bundled motion: {suggest(part, shipped)}"
                )
            found = [shipped[part]]
        files += found
    if not files:
        raise MotionFileError(
            f"motion_file: expected a motion, got {text!r}; use a file (--motion-file, or "
            f"motion_file of the command) or a bundled motion. Available: {', '.join(shipped)}."
        )
    return files


def _parts_of(text: str) -> list[str]:
    """Split `text` at commas outside existing paths; the longest existing path wins."""
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
    # `Path.exists` raises for strings longer than a path may be, such as long lists.
    return os.path.exists(os.path.expanduser(path))


def shipped_motions() -> dict[str, Path]:
    """Return the paths of the bundled motions by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.npz"))}


# Run folders.


def record_motions(
    files: Sequence[Path], run_dir: Path, registry_name: str | None = None
) -> list[Path]:
    """Copy motions into a run folder and record their sources; return the new files.

    Args:
        files: Motions, in order.
        run_dir: Run folder. An existing record is unchanged.
        registry_name: Weights & Biases artifact of the motions, recorded as their source.
    """
    folder = run_dir / FOLDER
    if (folder / INDEX).is_file():
        return []
    folder.mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = []
    for path in files:
        name, taken = path.name, {entry["file"] for entry in entries}
        free = (f"{path.stem}-{number}.npz" for number in itertools.count(2))
        while name in taken:
            name = next(free)
        # Resumed runs copy the motions from the folder of the run they resume.
        shutil.copyfile(path, folder / name)
        source = registry_name if registry_name is not None else str(path.resolve())
        entries.append({"file": name, "source": source, "sha256": motion_hash(folder / name)})
    # Written last: the index marks a complete record.
    with replacing(folder / INDEX) as file:
        file.write((json.dumps(entries, indent=2) + "\n").encode())
    return [*(folder / entry["file"] for entry in entries), folder / INDEX]


def recorded_motions(run_dir: Path) -> list[Path]:
    """Return the training motions of a run, in order; empty without a record.

    Raises:
        MotionFileError: the record is damaged, or a copy is missing or does not match its hash.
    """
    folder = run_dir / FOLDER
    index = folder / INDEX
    if not index.is_file():
        return []
    try:
        entries = json.loads(index.read_text(encoding="utf-8"))
        hashes = {folder / Path(str(entry["file"])).name: entry["sha256"] for entry in entries}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise MotionFileError(
            f"{index} is damaged ({error}); select the motion with --motion-file."
        ) from error
    for path, expected in hashes.items():
        if not path.is_file() or motion_hash(path) != expected:
            raise MotionFileError(
                f"Run {run_dir}: the copy {path} of a training motion is missing or was changed "
                "since; select the motion with --motion-file."
            )
    return list(hashes)


# Weights & Biases.


def fetch_artifact(registry_name: str) -> list[Path]:
    """Download an artifact such as `org/motions/dance` or `.../dance:v3`; return its motions.

    Raises:
        UserError: no login at Weights & Biases.
        WandbError: the artifact cannot be fetched.
        MotionFileError: the artifact contains no motion.
    """
    name = full_artifact_name(registry_name)
    with asking_wandb(f"Motion {name!r}") as wandb:
        return _motions_in(wandb.Api().artifact(name), name)


def full_artifact_name(registry_name: str) -> str:
    """Return the name with alias; the default alias is `:latest`."""
    return registry_name if ":" in registry_name else f"{registry_name}:{_DEFAULT_ALIAS}"


def fetch_motions_of_run(run_path: str) -> list[Path]:
    """Download the training motions of a run; return their paths.

    Motions are those recorded and uploaded by the run, or those of its used artifact of type
    `motions`.

    Args:
        run_path: entity/project/run.

    Raises:
        UserError: no login at Weights & Biases, the run path does not end in a name, or the name of a
            file leads out of its folder.
        WandbError: the run cannot be read.
        MotionFileError: the run has neither.
    """
    folder = inside(Path(tempfile.gettempdir()) / "mjlab-motions", Path(run_path).name)
    with asking_wandb(f"Run {run_path!r}") as wandb:
        run = wandb.Api().run(run_path)
        files = {f.name: f for f in run.files() if f.name.startswith(f"{FOLDER}/")}
        if f"{FOLDER}/{INDEX}" in files:
            folder = own_folder(folder)
            for name in files:
                inside(folder, name)
            for file in files.values():
                file.download(str(folder), replace=True)
            return recorded_motions(folder)
        used = [a for a in run.used_artifacts() if a.type == _ARTIFACT_TYPE]
        if used:
            return _motions_in(used[0], used[0].name)
    raise MotionFileError(
        f"Run {run_path!r} has neither recorded motions nor an artifact of type "
        f"{_ARTIFACT_TYPE!r}; select the motion with --motion-file or --registry-name."
    )


def _motions_in(artifact: Any, name: str) -> list[Path]:
    """Return the motions of an artifact: `motion.npz` (mjlab 1.6), else all `.npz` files."""
    folder = Path(artifact.download())
    if (folder / _ARTIFACT_FILE).is_file():
        return [folder / _ARTIFACT_FILE]
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise MotionFileError(f"Artifact {name!r}: expected motions (.npz), got none.")
    return files
