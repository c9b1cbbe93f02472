"""Finding motions: files, folders, those that ship with the package, Weights & Biases, folders of runs.

A run keeps the motions that it was trained on in its folder: copies, where they came from, and hashes.

    <run>/motion/motions.json   [{"file": "squat.npz", "source": "...", "sha256": "..."}, ...]
    <run>/motion/squat.npz      the copies, in that order
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
from mjlab.utils.os import own_folder, replacing
from mjlab.utils.string import suggest

FOLDER = "motion"
"""Name of the folder, in that of the run."""
INDEX = "motions.json"
"""Name of the list, in the folder."""
_ARTIFACT_TYPE = "motions"
_ARTIFACT_FILE = "motion.npz"
_DEFAULT_ALIAS = "latest"
SHIPPED = Path(__file__).parent / "motions"
"""Folder of the motions that ship with the package; a README there says what they are."""
# Commas that a path in a list may have; more are looked for in a single path only.
_MAX_COMMAS = 8


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
        raise MotionFileError(
            f"Unknown motion {part!r}; give a file, a folder, or a motion that ships with the package: "
            f"{suggest(part, shipped)}"
        )
    return [path]


def shipped_motions() -> dict[str, Path]:
    """Return the motions that ship with the package, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.npz"))}


# Folders of runs.


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
        name, taken = path.name, {entry["file"] for entry in entries}
        free = (f"{path.stem}-{number}.npz" for number in itertools.count(2))
        while name in taken:
            name = next(free)
        # Runs that go on from another one take their motions from that one's folder.
        shutil.copyfile(path, folder / name)
        source = registry_name if registry_name is not None else str(path.resolve())
        entries.append({"file": name, "source": source, "sha256": motion_hash(folder / name)})
    # Last, because its presence says that all the others are there.
    with replacing(folder / INDEX) as file:
        file.write((json.dumps(entries, indent=2) + "\n").encode())
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


# Weights & Biases.


def fetch_artifact(registry_name: str) -> list[Path]:
    """Return the motions in an artifact such as `org/motions/dance` or `.../dance:v3`, downloaded.

    Raises:
        MotionFileError: it cannot be fetched, or has no motion in it.
    """
    import wandb

    name = full_artifact_name(registry_name)
    try:
        artifact = wandb.Api().artifact(name)
        return _motions_in(artifact, name)
    except MotionFileError:
        raise
    except Exception as error:
        # wandb raises errors of many kinds, of its own and of what it is built on.
        raise MotionFileError(
            f"Cannot fetch the motion {name!r} from Weights & Biases: {error}"
        ) from error


def full_artifact_name(registry_name: str) -> str:
    """Return the name with an alias: `:latest` where there is none."""
    return registry_name if ":" in registry_name else f"{registry_name}:{_DEFAULT_ALIAS}"


def fetch_motions_of_run(run_path: str) -> list[Path]:
    """Return the motions that a run was trained on, downloaded.

    Those that the run recorded and uploaded, or the artifact of type `motions` that it used.

    Args:
        run_path: entity/project/run.

    Raises:
        MotionFileError: the run cannot be read, or has neither.
    """
    import wandb

    try:
        run = wandb.Api().run(run_path)
        files = [file for file in run.files() if file.name.startswith(f"{FOLDER}/")]
        if any(file.name == f"{FOLDER}/{INDEX}" for file in files):
            folder = Path(tempfile.gettempdir()) / "mjlab-motions" / Path(run_path).name
            folder = own_folder(folder)
            for file in files:
                file.download(str(folder), replace=True)
            return recorded_motions(folder)
        used = [a for a in run.used_artifacts() if a.type == _ARTIFACT_TYPE]
        if used:
            return _motions_in(used[0], used[0].name)
    except MotionFileError:
        raise
    except Exception as error:
        raise MotionFileError(
            f"Cannot read the run {run_path!r} at Weights & Biases: {error}"
        ) from error
    raise MotionFileError(
        f"The run {run_path!r} has neither recorded motions nor an artifact of type "
        f"{_ARTIFACT_TYPE!r}. Name the motion with --motion-file or --registry-name."
    )


def _motions_in(artifact: Any, name: str) -> list[Path]:
    """Return the motions in an artifact; `motion.npz`, as mjlab 1.6 calls it, or all there are."""
    folder = Path(artifact.download())
    if (folder / _ARTIFACT_FILE).is_file():
        return [folder / _ARTIFACT_FILE]
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise MotionFileError(f"The artifact {name!r} has no motion (.npz) in it.")
    return files
