"""`mjlab view`: models of any kind on a page."""

from __future__ import annotations

import html
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjlab.scripts.view import ViewConfig, load_model, run_view
from mjlab.utils.errors import UserError
from mjlab.viewer.viser.model_page import ModelPage, describe_model

MJCF = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1"><freejoint/><geom size=".1"/>
      <body name="arm"><joint name="elbow" range="-90 45"/><geom size=".02 .1" type="capsule"/></body>
    </body>
  </worldbody>
  <actuator><motor name="elbow_motor" joint="elbow" ctrlrange="-2 2"/></actuator>
  <keyframe><key name="bent" qpos="0 0 .5 1 0 0 0 .3" ctrl="1"/></keyframe>
</mujoco>
"""
URDF = """
<robot name="two"><link name="a"/>
  <link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry>{geometry}</geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "robot.xml"
    path.write_text(MJCF, encoding="utf-8")
    return path


@pytest.fixture
def page(file: Path, viser_server) -> ModelPage:
    return ModelPage(viser_server, "robot", load_model(str(file)), lambda: load_model(str(file)))


def test_a_robot_without_ground_gets_a_floor(file: Path) -> None:
    model = load_model(str(file))
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).sum() == 1


def test_urdf_and_binary_models_are_loaded(tmp_path: Path, file: Path) -> None:
    urdf = tmp_path / "two.urdf"
    urdf.write_text(URDF.format(geometry='<box size="1 1 1"/>'), encoding="utf-8")
    model = load_model(str(urdf))
    assert model.joint("hinge").range.tolist() == [-1.0, 1.0]
    # MuJoCo alone would drop the visual geoms.
    assert model.ngeom == 1
    binary = tmp_path / "robot.mjb"
    mujoco.mj_saveModel(load_model(str(file)), str(binary))
    assert load_model(str(binary)).nu == 1


def test_a_model_without_geoms_is_shown(tmp_path: Path, viser_server) -> None:
    body = '<body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="hinge"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    page = ModelPage(viser_server, "bare", model, lambda: model)
    assert list(page.joints) == ["hinge"]


def test_robots_and_tasks_are_loaded_with_a_ground() -> None:
    assert load_model("yam").nu > 0
    assert load_model("Mjlab-Cartpole-Swingup").joint("cartpole/slider") is not None


def test_a_folder_does_not_hide_the_robot_of_its_name(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "yam").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_model("yam").nu > 0


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("missing.xml", None, "missing.xml: expected a file"),
        (
            "broken.xml",
            "<mujoco><worldbody><geom/></worldbody></mujoco>",
            "broken.xml: MuJoCo cannot",
        ),
        (
            "mesh.urdf",
            URDF.format(geometry='<mesh filename="package://x/b.stl"/>').replace(
                "visual", "collision"
            ),
            "'package://x/b.stl'.* not found",
        ),
        ("robot.pdf", "", "robot.pdf"),
        ("robot.mjcf", MJCF, "ends in .xml, .urdf"),
    ],
)
def test_what_cannot_be_loaded_is_named(tmp_path: Path, name: str, text, message: str) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=message):
        run_view(str(path), ViewConfig(port=18124, open_browser=False))


def test_names_in_another_encoding_are_told(tmp_path: Path) -> None:
    path = tmp_path / "latin.xml"
    path.write_text(MJCF.replace("elbow", "elboé"), encoding="latin-1")
    with pytest.raises(UserError, match=r"latin.xml: MuJoCo cannot load .*utf-8"):
        load_model(str(path))


def test_an_unknown_name_lists_what_can_be_shown() -> None:
    with pytest.raises(UserError, match="g1, go1, yam.*Mjlab-Cartpole"):
        load_model("Mjlab-Cartpole-Swingupp")


def test_sliders_have_the_ranges_and_set_the_state(page: ModelPage) -> None:
    slider = page.joints["elbow"]
    assert (slider.min, slider.max) == pytest.approx((-np.pi / 2, np.pi / 4))
    # The first keyframe is the pose at the start.
    assert slider.value == pytest.approx(0.3)
    page.set_value("elbow", "qpos", -0.5)
    page.set_value("elbow_motor", "ctrl", 2.0)
    page.advance(0.01)
    assert page.data.joint("elbow").qpos == pytest.approx(-0.5)
    assert page.data.time == 0.0
    page.set_pose("initial")
    assert page.data.joint("elbow").qpos == 0.0
    assert page.data.actuator("elbow_motor").ctrl == 0.0


def test_physics_runs_in_real_time_when_asked_for(page: ModelPage) -> None:
    page.playing.value = True
    page.advance(0.1)
    assert page.data.time == pytest.approx(0.1, abs=page.model.opt.timestep)
    assert page.data.body("base").xpos[2] < 0.5


def test_reload_reads_the_file_and_keeps_the_model_if_it_is_damaged(
    page: ModelPage, file: Path
) -> None:
    file.write_text("<mujoco><nonsense/></mujoco>", encoding="utf-8")
    page.reload()
    page.advance(0.0)
    assert "nonsense" in page.message.content
    assert page.model.nu == 1
    file.write_text(MJCF.replace("-90 45", "-30 30"), encoding="utf-8")
    page.reload()
    page.advance(0.0)
    assert page.joints["elbow"].max == pytest.approx(np.pi / 6)


def test_joints_and_actuators_without_a_name_have_sliders(viser_server) -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='.1'/><body pos='1 0 0'><joint name='j'/>"
        "<geom size='.1'/></body></body></worldbody><actuator><motor joint='j'/></actuator></mujoco>"
    )
    page = ModelPage(viser_server, "unnamed", model, lambda: model)
    page.set_value("0", "qpos", 0.5)
    page.set_value("0", "ctrl", 0.25)
    page.advance(0.0)
    assert page.data.qpos.tolist() == [0.5, 0.0]
    assert page.data.ctrl.tolist() == [0.25]
    page.set_pose("initial")
    assert page.joints["0"].value == page.actuators["0"].value == 0.0


def test_physics_that_diverges_is_paused_with_the_reason(viser_server) -> None:
    gain = "<general joint='j' gainprm='1e9' biastype='affine' biasprm='0 -1e9 1e9'/>"
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' axis='0 1 0' pos='0 0 .3'/><geom size='.1'/></body>"
        f"</worldbody><actuator>{gain}</actuator></mujoco>"
    )
    page = ModelPage(viser_server, "stiff", model, lambda: model)
    page.set_value("0", "ctrl", 1.0)
    page.playing.value = True
    page.advance(1.0)
    assert not page.playing.value
    assert "diverged" in page.message.content
    assert page.data.qpos.tolist() == [0.0]


def test_sliders_follow_the_physics(viser_server) -> None:
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" range="-170 170"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    page = ModelPage(viser_server, "pendulum", model, lambda: model)
    page.playing.value = True
    for _ in range(10):
        page.advance(0.03)
    # Updated some times per second.
    assert 0.05 < page.joints["hinge"].value <= page.data.qpos[0]


@pytest.mark.parametrize("name", ['<iframe srcdoc="<script>">', "a|b", "[x](javascript:y)", "*"])
def test_names_of_a_model_are_text(viser_server, name: str) -> None:
    spec = mujoco.MjSpec.from_string(MJCF)
    spec.joint("elbow").name = name
    spec.actuators[0].target = name
    description = describe_model(name, spec.compile())
    assert not set(description) & set("<>[]{}")
    rows = [line for line in description.splitlines() if line.startswith("|")]
    assert {row.count("|") for row in rows} == {4}
    assert name in html.unescape(description)
    # Labels of controls are text.
    assert name in ModelPage(viser_server, name, spec.compile(), spec.compile).joints
