"""`mjlab check`: models of any kind and tasks, and the findings printed by other commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mjlab.asset_zoo.robots import get_go1_robot_cfg
from mjlab.cli.main import main
from mjlab.scripts.check import CheckConfig, check, check_entity, check_task
from mjlab.sensor import RayCastSensorCfg
from mjlab.tasks.registry import list_tasks, load_env_cfg
from mjlab.utils.errors import UserError

GO1, YAM = "Mjlab-Velocity-Rough-Unitree-Go1", "Mjlab-Lift-Cube-Yam"

URDF = """<robot name="arm">
  <link name="base"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="0.5" upper="1" effort="1" velocity="1"/>
  </joint>
  <link name="upper">
    <inertial><mass value="1"/>
      <inertia ixx="1e4" iyy="1e4" izz="1e4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.3"/></geometry></collision>
  </link>
</robot>
"""


@pytest.fixture
def urdf(tmp_path: Path) -> str:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF, encoding="utf-8")
    return str(path)


def faults(findings) -> dict[str, tuple[str, ...]]:
    return {finding.fault: finding.where for finding in findings}


def test_lines_of_a_urdf(urdf: str) -> None:
    found = faults(check(urdf))
    assert found["absurd inertia"] == (f"{urdf}:8",)
    assert found["zero armature"] == (f"{urdf}:4",)
    assert f"{urdf}:4" in found["initial pose outside the limits"]


def test_cures_of_a_urdf_are_in_the_config(urdf: str) -> None:
    found = {finding.fault: finding for finding in check(urdf, CheckConfig(floating_base=True))}
    assert "initial pose in the ground" not in found
    assert "config" in found["zero armature"].cure
    assert "<joint>" not in found["zero armature"].cure


def test_places_are_relative_to_the_working_folder(urdf: str, monkeypatch) -> None:
    monkeypatch.chdir(Path(urdf).parent)
    assert faults(check(urdf))["absurd inertia"] == ("arm.urdf:8",)


def test_stock_tasks_have_the_documented_findings_only() -> None:
    found = {task: set(faults(check(task))) for task in list_tasks() if task.startswith("Mjlab-")}
    soft = {task: {"gains too soft for the weight"} for task in found if "Yam" in task}
    assert {task: own for task, own in found.items() if own} == soft


def test_elements_of_a_task_have_their_line_in_the_robot_file() -> None:
    robot = get_go1_robot_cfg()
    robot.collisions = ()
    (place, *_) = faults(check_entity("robot", robot))["soles whose friction cannot be randomized"]
    file, _, line = place.rpartition(":")
    assert "foot_collision" in Path(file).read_text(encoding="utf-8").split("\n")[int(line) - 1]


def test_gains_of_a_task_are_found_at_their_setting() -> None:
    cfg = load_env_cfg(GO1)
    _, knee = cfg.scene.entities["robot"].articulation.actuators
    knee.stiffness = 4.0
    where = faults(check_task(cfg))["gains too soft for the weight"]
    assert "scene.entities['robot'].articulation.actuators[1]" in where


def test_a_pattern_of_actuators_that_misses_joints() -> None:
    cfg = load_env_cfg(GO1)
    knee = cfg.scene.entities["robot"].articulation.actuators[1]
    knee.target_names_expr = ("F._calf_joint",)
    cfg.actions["joint_pos"].scale = 0.25
    found = faults(check_task(cfg))["joints without an actuator"]
    assert len(found) == 2


@pytest.mark.parametrize("setting", ["actuator_names", "scale"])
def test_a_pattern_of_actions_that_misses_joints(setting: str) -> None:
    cfg = load_env_cfg(GO1)
    pattern = "(?!RL_calf).*"
    setattr(
        cfg.actions["joint_pos"],
        setting,
        (pattern,) if setting == "actuator_names" else {pattern: 0.2},
    )
    (finding,) = check_task(cfg)
    assert finding.fault == "joints that a pattern misses"
    assert "RL_calf_joint" in finding.what


def test_a_pattern_of_observations_that_misses_joints() -> None:
    from mjlab.managers import SceneEntityCfg

    cfg = load_env_cfg(GO1)
    selection = SceneEntityCfg("robot", joint_names=(".*_(hip|thigh)_joint",))
    for term in cfg.observations["actor"].terms.values():
        if "joint" in term.func.__name__:
            term.params = {**term.params, "asset_cfg": selection}
    (finding,) = check_task(cfg)
    assert "actor" in finding.where[0]
    assert "calf" in finding.what


def test_rays_of_a_task_see_its_groups() -> None:
    cfg = load_env_cfg(GO1)
    rays = [sensor for sensor in cfg.scene.sensors if isinstance(sensor, RayCastSensorCfg)]
    cfg.scene.sensors = tuple(replace(sensor, include_geom_groups=(0, 3)) for sensor in rays)
    assert "geoms that terrain rays see" in faults(check_task(cfg))


def test_a_function_that_returns_a_spec() -> None:
    found = faults(check("mjlab.asset_zoo.robots.unitree_go1.go1_constants:get_spec"))
    assert any("go1.xml:" in place for place in found["initial pose outside the limits"])


def test_an_element_without_a_file_has_its_path() -> None:
    found = faults(check("tests.scripts.test_check:fileless"))
    assert "upper/shoulder" in found["initial pose outside the limits"]


def fileless():
    import mujoco

    return mujoco.MjSpec.from_string(URDF)


def test_status_and_formats(run_main, urdf: str) -> None:
    outcome = run_main(main, "mjlab", "check", urdf)
    assert outcome.status == 0
    assert "arm.urdf:8" in outcome.out
    outcome = run_main(main, "mjlab", "check", urdf, "--strict", "--json")
    assert outcome.status == 1
    assert {finding["fault"] for finding in json.loads(outcome.out)} >= {"absurd inertia"}
    assert run_main(main, "mjlab", "check", "go1", "--strict").status == 0


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><geom/></worldbody></mujoco>", encoding="utf-8")
    with pytest.raises(UserError, match=r"robot\.xml: "):
        check(str(path))
    with pytest.raises(UserError, match="module:function"):
        check("Mjlab-Velocity-Flat-Unitree-Go2")


def test_describe_adds_the_findings(run_main) -> None:
    outcome = run_main(main, "mjlab", "describe", YAM, "--check")
    assert "gains too soft for the weight" in outcome.out
    outcome = run_main(main, "mjlab", "describe", YAM, "--check", "--json")
    assert [finding["fault"] for finding in json.loads(outcome.out)["findings"]]
