"""URDF reader: MuJoCo's, with visual geoms, the root link, and the meshes of ROS packages."""

from __future__ import annotations

import warnings
from pathlib import Path
from xml.etree import ElementTree

import mujoco

VISUAL_GROUP, COLLISION_GROUP = 2, 3
"""Geom groups of visual and colliding geoms, as in the robots of the asset zoo."""

# Formats of MuJoCo's mesh decoders.
_FORMATS = (".msh", ".obj", ".stl")


def read_urdf(path: str | Path, *, floating_base: bool = False) -> mujoco.MjSpec:
    """Return the spec of a URDF.

    MuJoCo by itself drops visual geoms, merges the root link with the world, and knows no ROS packages:
    `package://NAME/FILE` becomes the first existing FILE or NAME/FILE below the folders above the
    URDF. Mesh paths of the spec are absolute. A URDF with a `<mujoco>` element is read as that
    element says.

    Visual geoms with meshes that are not found or not in MuJoCo's formats (such as .dae) are dropped,
    with one warning.

    A URDF has no actuators and no ground: see `EntityArticulationInfoCfg` and `TerrainEntityCfg`.

    Args:
        path: File.
        floating_base: Add a free joint to the root link.

    Raises:
        ValueError: not a URDF, or the mesh of a colliding geom is not found.
    """
    path = Path(path)
    try:
        robot = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not an XML file: {error}") from error
    if robot.find("mujoco") is not None:
        spec = mujoco.MjSpec.from_file(str(path))
        _drop_unreadable_visuals(spec, path)
    else:
        files = _name_meshes(robot)
        options = ElementTree.SubElement(robot, "mujoco")
        kept = {"discardvisual": "false", "strippath": "false", "fusestatic": "false"}
        ElementTree.SubElement(options, "compiler", kept)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
        for mesh in spec.meshes:
            mesh.file = _mesh_file(path, files[mesh.file])
        _drop_unreadable_visuals(spec, path)
        collides = {geom: bool(geom.contype or geom.conaffinity) for geom in spec.geoms}
        for geom, is_collision in collides.items():
            # Without visual geoms, the colliding ones are shown.
            is_hidden = is_collision and not all(collides.values())
            geom.group = COLLISION_GROUP if is_hidden else VISUAL_GROUP
    if floating_base:
        spec.worldbody.first_body().add_freejoint()
    return spec


def _name_meshes(robot: ElementTree.Element) -> dict[str, str]:
    """Give each mesh file of a URDF a separate stem, and return the file by its new name.

    MuJoCo names meshes by their stem, so `visual/arm.dae` and `collision/arm.stl` would be one mesh.
    """
    names: dict[str, str] = {}
    stems: set[str] = set()
    for mesh in robot.iter("mesh"):
        file = mesh.get("filename", "")
        if file not in names:
            stem = Path(file).stem
            while stem in stems:
                stem += "_"
            stems.add(stem)
            names[file] = stem + Path(file).suffix
        mesh.set("filename", names[file])
    return {name: file for file, name in names.items()}


def _mesh_file(urdf: Path, name: str) -> str:
    """Return the absolute path of a mesh of a URDF; `name` if it is not found."""
    package, _, file = name.removeprefix("package://").partition("/")
    folders = [urdf.resolve().parent] if file == "" else urdf.resolve().parents
    tried = [folder / part for folder in folders for part in (file, f"{package}/{file}")]
    if not name.startswith("package://"):
        tried = [urdf.resolve().parent / name.removeprefix("file://")]
    return next((str(candidate) for candidate in tried if candidate.is_file()), name)


def _drop_unreadable_visuals(spec: mujoco.MjSpec, urdf: Path) -> None:
    """Delete visual geoms with meshes that MuJoCo cannot read.

    Raises:
        ValueError: the mesh of a colliding geom is not found.
    """
    files = {
        mesh.name: Path(spec.modelfiledir, mesh.compiler.meshdir, mesh.file) for mesh in spec.meshes
    }
    missing = {name for name, file in files.items() if not file.is_file()}
    unreadable = {name for name, file in files.items() if file.suffix.lower() not in _FORMATS}
    dropped = []
    for geom in list(spec.geoms):
        if geom.meshname not in missing | unreadable:
            continue
        file = spec.mesh(geom.meshname).file
        if not (geom.contype or geom.conaffinity):
            dropped.append(file)
            spec.delete(geom)
        elif geom.meshname in missing:
            raise ValueError(
                f"{urdf}: mesh {file!r} of a colliding geom not found; paths are relative to the "
                "URDF, and packages are searched in the folders above it."
            )
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name in (missing | unreadable) - used:
            spec.delete(mesh)
    if dropped:
        warnings.warn(
            f"{urdf}: dropped {len(dropped)} visual geoms, because MuJoCo cannot read their meshes "
            f"{list(dict.fromkeys(dropped))}; provide the files as {', '.join(_FORMATS)}.",
            UserWarning,
            stacklevel=3,
        )
