"""URDF reader: MuJoCo's, with visual geoms, the root link, and the meshes of ROS packages."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import mujoco

VISUAL_GROUP, COLLISION_GROUP = 2, 3
"""Geom groups of visual and colliding geoms, as in the robots of the asset zoo."""


def read_urdf(path: str | Path, *, floating_base: bool = False) -> mujoco.MjSpec:
    """Return the spec of a URDF.

    MuJoCo by itself drops visual geoms, merges the root link with the world, and knows no ROS packages:
    `package://NAME/FILE` becomes the first existing FILE or NAME/FILE below the folders above the
    URDF. Mesh paths of the spec are absolute. A URDF with a `<mujoco>` element is read as that
    element says.

    A URDF has no actuators and no ground: see `EntityArticulationInfoCfg` and `TerrainEntityCfg`.

    Args:
        path: File.
        floating_base: Add a free joint to the root link.

    Raises:
        ValueError: not a URDF, or a mesh is not found.
    """
    path = Path(path)
    try:
        robot = ElementTree.fromstring(path.read_text(encoding="utf-8"))
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not an XML file: {error}") from error
    if robot.find("mujoco") is not None:
        spec = mujoco.MjSpec.from_file(str(path))
    else:
        for mesh in robot.iter("mesh"):
            mesh.set("filename", str(_mesh_file(path, mesh.get("filename", ""))))
        options = ElementTree.SubElement(robot, "mujoco")
        kept = {"discardvisual": "false", "strippath": "false", "fusestatic": "false"}
        ElementTree.SubElement(options, "compiler", kept)
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
        collides = {geom: bool(geom.contype or geom.conaffinity) for geom in spec.geoms}
        for geom, is_collision in collides.items():
            # Without visual geoms, the colliding ones are shown.
            is_hidden = is_collision and not all(collides.values())
            geom.group = COLLISION_GROUP if is_hidden else VISUAL_GROUP
    if floating_base:
        spec.worldbody.first_body().add_freejoint()
    return spec


def _mesh_file(urdf: Path, name: str) -> Path:
    """Return the file of a mesh of a URDF. Raises ValueError if it is not found."""
    package, _, file = name.removeprefix("package://").partition("/")
    folders = [urdf.resolve().parent] if file == "" else urdf.resolve().parents
    tried = [folder / part for folder in folders for part in (file, f"{package}/{file}")]
    if not name.startswith("package://"):
        tried = [urdf.resolve().parent / name.removeprefix("file://")]
    found = [candidate for candidate in tried if candidate.is_file()]
    if not found:
        raise ValueError(
            f"{urdf}: mesh {name!r} not found; looked for {tried[0]} and in the folders above, for "
            "packages"
        )
    return found[0]
