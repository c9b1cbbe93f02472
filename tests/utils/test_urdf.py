from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import pytest

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg
from mjlab.utils.urdf import COLLISION_GROUP, VISUAL_GROUP, read_urdf
from mjlab.utils.xml import export_spec

_INERTIAL = """<inertial><mass value="{mass}"/>
    <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>"""
_MESH = '<visual><geometry><mesh filename="package://two_description/meshes/part.obj"/></geometry></visual>'
_SPHERE = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
_ROBOT = f"""
<robot name="two">
  <link name="base">{_INERTIAL.format(mass=2)}{_MESH}{_SPHERE}</link>
  <link name="arm">{_INERTIAL.format(mass=1)}{_SPHERE}</link>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    package = tmp_path / "two_description"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    corners = ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    faces = ("1 3 2", "1 2 4", "1 4 3", "2 3 4")
    lines = [*(f"v {corner}" for corner in corners), *(f"f {face}" for face in faces)]
    (package / "meshes" / "part.obj").write_text("\n".join(lines), encoding="utf-8")
    path = package / "urdf" / "two.urdf"
    path.write_text(_ROBOT, encoding="utf-8")
    return path


def test_visual_geoms_meshes_of_packages_and_the_root_link_are_kept(urdf: Path) -> None:
    model = read_urdf(urdf).compile()
    assert model.nmesh == 1
    # MuJoCo alone would merge the base with the world and lose its mass.
    assert model.body("base").mass[0] == pytest.approx(2.0)
    assert model.body_mass.sum() == pytest.approx(3.0)
    assert (model.nq, model.nv) == (1, 1)
    groups = {
        int(type_): int(group)
        for type_, group in zip(model.geom_type, model.geom_group, strict=True)
    }
    assert groups == {
        int(mujoco.mjtGeom.mjGEOM_MESH): VISUAL_GROUP,
        int(mujoco.mjtGeom.mjGEOM_SPHERE): COLLISION_GROUP,
    }


def test_colliding_geoms_are_shown_if_there_are_no_others(urdf: Path) -> None:
    urdf.write_text(_ROBOT.replace(_MESH, ""), encoding="utf-8")
    assert {geom.group for geom in read_urdf(urdf).geoms} == {VISUAL_GROUP}


def test_a_urdf_becomes_an_entity_and_an_mjcf(urdf: Path, tmp_path: Path) -> None:
    cfg = EntityCfg(
        spec_fn=lambda: read_urdf(urdf, floating_base=True),
        articulation=EntityArticulationInfoCfg(
            actuators=(
                BuiltinPositionActuatorCfg(
                    target_names_expr=("elbow",), stiffness=10.0, damping=1.0
                ),
            )
        ),
    )
    entity = Entity(cfg)
    assert not entity.is_fixed_base
    assert entity.joint_names == ("elbow",)
    export_spec(read_urdf(urdf, floating_base=True), tmp_path / "export")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "export" / "scene.xml"))
    assert model.body("base").mass[0] == pytest.approx(2.0)
    assert (model.nq, model.ngeom) == (8, 3)


def test_a_mujoco_element_takes_precedence(urdf: Path) -> None:
    options = '<mujoco><compiler fusestatic="true" discardvisual="true"/></mujoco></robot>'
    urdf.write_text(_ROBOT.replace("</robot>", options), encoding="utf-8")
    assert read_urdf(urdf).compile().nmesh == 0


def test_a_missing_mesh_of_a_colliding_geom_is_named(urdf: Path) -> None:
    collision = _MESH.replace("visual>", "collision>")
    text = _ROBOT.replace(_MESH, collision).replace("part.obj", "other.obj")
    urdf.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"two.urdf: mesh 'package://.*other.obj'.*not found"):
        read_urdf(urdf)


@pytest.mark.parametrize("options", ["", '<mujoco><compiler discardvisual="false"/></mujoco>'])
@pytest.mark.parametrize("name", ["part.dae", "part.glb", "other.obj", "OTHER.STL"])
def test_visual_meshes_that_cannot_be_read_are_dropped(urdf: Path, name: str, options: str) -> None:
    (urdf.parents[1] / "meshes" / "part.dae").write_text("<COLLADA/>", encoding="utf-8")
    part = "package://two_description/meshes/part.obj"
    other = f"package://two_description/meshes/{name}"
    both = _MESH.replace(part, other) + _MESH.replace(part, other)
    text = _ROBOT.replace(_MESH, both).replace("</robot>", f"{options}</robot>")
    urdf.write_text(text, encoding="utf-8")
    with pytest.warns(UserWarning, match=f"dropped 2 visual geoms.*{name}") as caught:
        model = read_urdf(urdf).compile()
    assert len(caught) == 1
    assert (model.nmesh, model.ngeom, model.nv) == (0, 2, 1)
    assert model.body("arm").mass[0] == pytest.approx(1.0)


def test_meshes_with_the_same_stem_stay_apart(urdf: Path) -> None:
    folder = urdf.parents[1] / "meshes"
    (folder / "collision").mkdir()
    text = (folder / "part.obj").read_text(encoding="utf-8")
    (folder / "collision" / "part.obj").write_text(text.replace("v 1 0 0", "v 5 0 0"))
    collision = _MESH.replace("visual>", "collision>").replace("part.obj", "collision/part.obj")
    for visual in (_MESH, _MESH.replace("part.obj", "part.dae")):
        urdf.write_text(_ROBOT.replace(_MESH, visual + collision), encoding="utf-8")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = read_urdf(urdf).compile()
        sizes = {
            bool(model.geom_contype[i]): model.geom_aabb[i, 3:].max()
            for i in range(model.ngeom)
            if model.geom_dataid[i] >= 0
        }
        assert sizes[True] > 2.0
        assert sizes.get(False, 0.0) < 1.0
