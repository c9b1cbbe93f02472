"""A model file and what it refers to, copied into a package."""

from __future__ import annotations

import shutil
import tempfile
import warnings
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from mjlab.own_robot.model_source import RobotModel, load_model
from mjlab.utils.xml import asset_files, export_spec


def copy_model(model: RobotModel, folder: Path) -> Path:
    """Copy the model and its files to a new folder; return its file, relative to `folder`.

    A file is copied as it is, with all that it refers to in the same places beside it. Where the copy
    would not load as the original does (absolute paths, meshes that MuJoCo cannot read), and for a
    function, an MJCF of the spec is written instead.

    Args:
        model: Model as loaded.
        folder: Folder to create.
    """
    if model.file is not None:
        with tempfile.TemporaryDirectory() as temporary:
            copy = _copy_files(model.file, model.spec, Path(temporary))
            if _is_complete(Path(temporary) / copy, Path(temporary)):
                shutil.copytree(temporary, folder)
                return copy
    export_spec(model.spec, folder)
    name = Path(f"{model.name}.xml")
    (folder / "scene.xml").rename(folder / name)
    return name


def _copy_files(file: Path, spec: mujoco.MjSpec, folder: Path) -> Path:
    """Copy a model file, its includes and assets with their relative places; return its new place."""
    file = file.resolve()
    files = {file, *_included(file), *(path.resolve() for path in asset_files(spec))}
    root = file.parent
    # Meshes may stand beside the folder of the file: `../meshes/base.stl`.
    while not all(path.is_relative_to(root) for path in files):
        root = root.parent
    for path in files:
        target = folder / path.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return file.relative_to(root)


def _included(file: Path) -> set[Path]:
    """Return the files that an MJCF includes. MuJoCo's paths are relative to the including file."""
    found: set[Path] = set()
    for include in ElementTree.parse(file).getroot().iter("include"):
        path = (file.parent / include.get("file", "")).resolve()
        if path.is_file() and path not in found:
            found |= {path, *_included(path)}
    return found


def _is_complete(file: Path, folder: Path) -> bool:
    """Return True if the copy loads without warnings and refers to files of its folder only."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            spec = load_model(str(file)).spec
        except (ValueError, OSError):
            return False
    inside = folder.resolve()
    return not caught and all(p.resolve().is_relative_to(inside) for p in asset_files(spec))
