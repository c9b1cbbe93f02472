"""A robot's model from a file, folder, archive, function or MuJoCo Menagerie."""

from __future__ import annotations

import atexit
import importlib
import keyword
import re
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from mjlab.utils.urdf import read_urdf


@dataclass(frozen=True)
class RobotModel:
    """A robot's model as its file has it."""

    spec: mujoco.MjSpec
    """Spec, unchanged: elements may lack names (see `name_elements`)."""
    name: str
    """Name for folders and tasks: lower-case letters, digits and underscores."""
    source: str
    """Source as given."""
    file: Path | None
    """Model file; None for a function."""
    assets: Path | None
    """Folder of the model file, with its meshes."""

    @property
    def is_urdf(self) -> bool:
        """True if the model file is a URDF, which has no free joint and no actuators."""
        return self.file is not None and _root_tag(self.file) == "robot"


def load_model(source: str, *, floating_base: bool = False) -> RobotModel:
    """Return the model of `source`.

    Args:
        source: Path of an MJCF or URDF file, or of a folder or zip archive that holds one with its
            meshes; `module:function` that returns an `MjSpec`; or `menagerie:NAME`.
        floating_base: Add a free joint to the root link of a URDF, which cannot have one.

    Raises:
        ValueError: not a robot's model, or several candidates, which the message lists; a name that
            MuJoCo Menagerie does not have, or a failed download.
        ModuleNotFoundError: the package of a function, or `mujoco-menagerie`, is missing.
    """
    path = Path(source).expanduser()
    if path.exists():
        file = model_file(path)
    elif source.startswith("menagerie:"):
        file = _menagerie_file(source.removeprefix("menagerie:"))
    elif ":" in source:
        return _from_function(source)
    else:
        raise ValueError(
            f"Model {source!r}: expected an MJCF or URDF file, a folder, a zip archive, "
            "`module:function` or `menagerie:NAME`; no such file."
        )
    if _root_tag(file) == "robot":
        spec = read_urdf(file, floating_base=floating_base)
    else:
        spec = mujoco.MjSpec.from_file(str(file))
        _drop_dangling_pairs(spec, file)
    generic = {"robot", "model", "scene", "main"}
    name = file.stem if file.stem.lower() not in generic else file.resolve().parent.name
    return RobotModel(spec, identifier(name), source, file, file.resolve().parent)


def identifier(name: str) -> str:
    """Return a name as a Python name of lower-case letters, digits and underscores."""
    word = re.sub(r"\W+", "_", name.lower()).strip("_") or "robot"
    if keyword.iskeyword(word):
        return f"{word}_"
    return word if word.isidentifier() else f"_{word}"


def model_file(path: Path) -> Path:
    """Return the model file of a path: itself, or the plainest robot in a folder or archive.

    A model that another file includes is plainer than the one that includes it, and `scene*.xml`
    comes last.

    Raises:
        ValueError: no model, or several that nothing orders.
    """
    if path.is_file() and path.suffix.lower() != ".zip":
        return path
    if path.is_file():
        folder = Path(tempfile.mkdtemp(prefix="mjlab_robot_"))
        # Specs read their meshes when they are compiled.
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
    else:
        folder = path
    candidates = [file for file in _xml_files(folder) if _is_robot(file)]
    if not candidates:
        raise ValueError(f"Model {str(path)!r}: no MJCF or URDF with a body found; name the file.")
    ranks = {file: _rank(file, folder) for file in candidates}
    best = min(ranks.values())
    plainest = [file for file in candidates if ranks[file] == best]
    if len(plainest) > 1:
        names = [str(file.relative_to(folder)) for file in plainest]
        raise ValueError(f"Model {str(path)!r}: {len(names)} candidates; name one of {names}.")
    return plainest[0]


def name_elements(spec: mujoco.MjSpec) -> list[str]:
    """Name the unnamed bodies, joints and geoms of a spec; return the new names.

    A geom is named after its body: `FL_foot_collision`, `FL_foot_visual2`.
    """
    new = []
    taken = {
        kind: {element.name for element in elements}
        for kind, elements in (("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms))
    }
    number = 0
    for body in spec.bodies:
        if not body.name:
            number += 1
            body.name = _free_name(f"link{number}", taken["body"])
            new.append(body.name)
        for joint in body.joints:
            if not joint.name:
                joint.name = _free_name(f"{body.name}_joint", taken["joint"])
                new.append(joint.name)
        for geom in body.geoms:
            if not geom.name:
                role = "collision" if geom.contype or geom.conaffinity else "visual"
                geom.name = _free_name(f"{body.name}_{role}", taken["geom"])
                new.append(geom.name)
    return new


def _free_name(base: str, taken: set[str]) -> str:
    name, number = base, 1
    while name in taken:
        number += 1
        name = f"{base}{number}"
    taken.add(name)
    return name


def _xml_files(folder: Path) -> Iterator[Path]:
    for suffix in ("xml", "mjcf", "urdf"):
        yield from sorted(folder.rglob(f"*.{suffix}"))


def _root_tag(file: Path) -> str:
    """Return the tag of the root element; empty for what is not XML."""
    try:
        return ElementTree.parse(file).getroot().tag
    except (ElementTree.ParseError, UnicodeDecodeError):
        return ""


def _is_robot(file: Path) -> bool:
    """Return True for a URDF with a link, or an MJCF with a body or an include."""
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError):
        return False
    if root.tag == "robot":
        return root.find("link") is not None
    return root.tag == "mujoco" and (
        root.find("worldbody//body") is not None or root.find("include") is not None
    )


def _rank(file: Path, folder: Path) -> tuple:
    """Return the order of a candidate: plainest first."""
    root = ElementTree.parse(file).getroot()
    stem = file.stem.lower()
    has_body = root.tag == "robot" or root.find("worldbody//body") is not None
    named = folder.name.lower().replace("-", "_")
    return (
        not has_body,
        "scene" in stem,
        root.tag == "robot",
        len(file.relative_to(folder).parts),
        any(word in stem for word in ("mjx", "original", "old", "hand")),
        stem not in named and named not in stem,
        len(stem),
    )


def _drop_dangling_pairs(spec: mujoco.MjSpec, file: Path) -> None:
    """Delete contact pairs with geoms of a scene that includes the robot, such as its floor."""
    geoms = {geom.name for geom in spec.geoms}
    dangling = [pair for pair in spec.pairs if not {pair.geomname1, pair.geomname2} <= geoms]
    missing = {name for p in dangling for name in (p.geomname1, p.geomname2)} - geoms
    for pair in dangling:
        spec.delete(pair)
    if dangling:
        warnings.warn(
            f"{file}: dropped {len(dangling)} contact pairs with geoms {sorted(missing)}, which the "
            "file does not have.",
            UserWarning,
            stacklevel=3,
        )


def _from_function(source: str) -> RobotModel:
    module, _, name = source.partition(":")
    result = getattr(importlib.import_module(module), name)()
    if not isinstance(result, mujoco.MjSpec):
        raise ValueError(
            f"Model {source!r}: expected a function that returns an MjSpec, "
            f"got {type(result).__name__}."
        )
    model = result.modelname
    return RobotModel(
        result, identifier(model if model not in ("", "MuJoCo Model") else name), source, None, None
    )


def _menagerie_file(name: str) -> Path:
    try:
        menagerie = importlib.import_module("mujoco_menagerie")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Model 'menagerie:{name}': package mujoco-menagerie not found; install mjlab[menagerie]."
        ) from error
    try:
        robot = menagerie.get(name)
        # The robot alone: the default entry is its scene.
        return Path(robot.xml(robot.default_model))
    except menagerie.MenagerieError as error:
        raise ValueError(f"Model 'menagerie:{name}': {error}") from error
