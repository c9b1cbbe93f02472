"""Export of a spec with its files."""

from __future__ import annotations

import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjlab.utils.spec import auto_wrap_fixed_base_mocap, export_spec, make_asset_paths_absolute

TETRA = "v 0 0 0\nv {0} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ROBOT = """
<mujoco model="{name}"><compiler meshdir="{folder}"/>
  <asset><mesh name="part" file="{file}"/></asset>
  <worldbody><body name="base"><joint name="j"/><geom type="mesh" mesh="part"/></body></worldbody>
</mujoco>
"""


def _robot_file(root: Path, name: str, folder: str, file: str, size: float) -> Path:
    mesh = root / name / folder / file
    mesh.parent.mkdir(parents=True)
    mesh.write_text(TETRA.format(size))
    xml = root / name / "robot.xml"
    xml.write_text(ROBOT.format(name=name, folder=folder, file=file))
    return xml


def test_robots_read_from_files_are_written_with_their_meshes(tmp_path):
    scene = mujoco.MjSpec()
    paths = (
        _robot_file(tmp_path, "one", "meshes", "part.obj", 1.0),
        _robot_file(tmp_path, "two", "assets", "sub/part.obj", 3.0),
    )
    for path in paths:
        spec = auto_wrap_fixed_base_mocap(lambda path=path: mujoco.MjSpec.from_file(str(path)))()
        scene.attach(spec, prefix=f"{path.parent.name}/", frame=scene.worldbody.add_frame())
    export_spec(scene, tmp_path / "out")
    read = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    direct = scene.compile()
    # The meshes have one file name, but different vertices.
    np.testing.assert_allclose(read.mesh_vert, direct.mesh_vert, atol=1e-6)
    assert [read.body(i).name for i in range(read.nbody)] == [
        direct.body(i).name for i in range(direct.nbody)
    ]


def test_assets_given_as_bytes_are_found_by_key_and_by_ending(tmp_path):
    spec = mujoco.MjSpec()
    spec.meshdir = "meshes"
    spec.assets = {
        "meshes/a.obj": TETRA.format(1).encode(),
        "b.obj": TETRA.format(2).encode(),
    }
    for name in "ab":
        spec.add_mesh(name=name, file=f"{name}.obj")
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    direct = spec.compile()
    export_spec(spec, tmp_path / "out")
    files = {path.name for path in (tmp_path / "out" / "assets").iterdir()}
    assert files == {"a.obj", "b.obj"}
    read = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    np.testing.assert_allclose(read.mesh_vert, direct.mesh_vert, atol=1e-6)


def test_the_spec_itself_is_not_changed(tmp_path):
    path = _robot_file(tmp_path, "one", "meshes", "part.obj", 1.0)
    spec = mujoco.MjSpec.from_file(str(path))
    export_spec(spec, tmp_path / "out")
    assert (spec.meshes[0].file, spec.meshdir) == ("part.obj", "meshes")
    spec.compile()


def test_an_archive_leaves_folders_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious").touch()
    path = _robot_file(tmp_path, "one", "meshes", "part.obj", 1.0)
    export_spec(mujoco.MjSpec.from_file(str(path)), tmp_path / "out", zip=True)
    assert (tmp_path / "out" / "precious").exists()
    with zipfile.ZipFile(tmp_path / "out.zip") as archive:
        files = {name for name in archive.namelist() if not name.endswith("/")}
    assert files == {"scene.xml", "assets/part.obj"}


def test_a_missing_file_is_named_and_nothing_is_written(tmp_path):
    spec = mujoco.MjSpec()
    spec.add_mesh(name="gone", file="gone.obj")
    with pytest.raises(ValueError, match=r"'gone': file 'gone.obj'"):
        export_spec(spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_spec_that_is_part_of_another_is_refused(tmp_path):
    part, whole = mujoco.MjSpec(), mujoco.MjSpec()
    whole.attach(part, prefix="", frame=whole.worldbody.add_frame())
    with pytest.raises(ValueError, match="attached to another"):
        export_spec(part, tmp_path / "out")
    export_spec(whole, tmp_path / "out")


def test_paths_become_absolute_where_there_is_a_file(tmp_path):
    path = _robot_file(tmp_path, "one", "meshes", "part.obj", 1.0)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.add_mesh(name="asset", file="memory.obj")
    spec.assets = {"memory.obj": TETRA.format(1).encode()}
    make_asset_paths_absolute(spec)
    assert spec.mesh("part").file == str(tmp_path / "one" / "meshes" / "part.obj")
    assert spec.mesh("asset").file == "memory.obj"
