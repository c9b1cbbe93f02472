"""Motions at Weights & Biases: fetching those of a registry or of a run."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_record import FOLDER, INDEX, recorded_motions
from mjlab.utils.os import own_folder

_ARTIFACT_TYPE = "motions"
_ARTIFACT_FILE = "motion.npz"
_DEFAULT_ALIAS = "latest"


def full_artifact_name(registry_name: str) -> str:
    """Return the name with an alias: `:latest` where there is none."""
    return registry_name if ":" in registry_name else f"{registry_name}:{_DEFAULT_ALIAS}"


def fetch_artifact(registry_name: str) -> list[Path]:
    """Return the motions in an artifact such as `org/motions/dance` or `.../dance:v3`, downloaded.

    Raises:
        MotionFileError: it cannot be fetched, or has no motion in it.
    """
    name = full_artifact_name(registry_name)
    try:
        artifact = _api().artifact(name)
        return _motions_in(artifact, name)
    except MotionFileError:
        raise
    except Exception as error:
        # wandb raises errors of many kinds, of its own and of what it is built on.
        raise MotionFileError(
            f"Cannot fetch the motion {name!r} from Weights & Biases: {error}"
        ) from error


def fetch_motions_of_run(run_path: str) -> list[Path]:
    """Return the motions that a run was trained on, downloaded.

    Those that the run recorded and uploaded, or the artifact of type `motions` that it used.

    Args:
        run_path: entity/project/run.

    Raises:
        MotionFileError: the run cannot be read, or has neither.
    """
    try:
        run = _api().run(run_path)
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


def _api() -> Any:
    import wandb

    return wandb.Api()
