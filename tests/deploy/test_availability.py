"""Terms and sensors that a robot can measure, and those that it cannot."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from bundles import write_random

from mjlab.deploy.availability import of_sensor
from mjlab.deploy.evidence import Evidence
from mjlab.deploy.fitness import fitness_warnings
from mjlab.deploy.measurements import Subject, sensor
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationTermCfg
from mjlab.scripts.describe import DescribeConfig, describe
from mjlab.tasks.registry import load_env_cfg


def unmeasured_by_actor(task: str) -> set[str]:
    rows = describe(task).as_json()["unmeasured"]
    return {row["term"] for row in rows if row["group"] == "actor"}


@pytest.mark.parametrize(
    ("task", "terms"),
    [
        ("Mjlab-Velocity-Flat-Unitree-Go1", {"base_lin_vel"}),
        ("Mjlab-Velocity-Rough-Unitree-G1", {"base_lin_vel", "height_scan"}),
        ("Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation", set()),
        ("Mjlab-Velocity-Rough-Unitree-G1-No-State-Estimation", set()),
        ("Mjlab-Tracking-Flat-Unitree-G1", {"motion_anchor_pos_b", "base_lin_vel"}),
        ("Mjlab-Tracking-Flat-Unitree-G1-No-State-Estimation", set()),
        ("Mjlab-Reach-Yam", set()),
        ("Mjlab-Lift-Cube-Yam", {"ee_to_cube", "cube_to_goal"}),
    ],
)
def test_actor_of_stock_task(task: str, terms: set[str]) -> None:
    assert unmeasured_by_actor(task) == terms


def test_privileged_terms_of_the_critic_are_marked() -> None:
    rows = describe("Mjlab-Velocity-Flat-Unitree-Go1-No-State-Estimation").as_json()["unmeasured"]
    assert {row["group"] for row in rows} == {"critic"}
    assert {"base_lin_vel", "foot_contact_forces"} <= {row["term"] for row in rows}


# Sensors: a robot that moves freely, an arm, and an object.

XML = """<mujoco>
  <worldbody>
    <body name="robot/base">{joint}<geom size=".1"/><site name="robot/imu"/>
      <body name="robot/arm" pos=".3 0 0"><joint name="robot/elbow" axis="0 1 0"/><geom size=".1"/>
        <site name="robot/hand" pos=".2 0 0"/></body>
    </body>
    <body name="cube/cube" pos="1 0 0"><freejoint/><geom size=".1"/></body>
  </worldbody>
  <sensor>
    <gyro name="robot/gyro" site="robot/imu"/>
    <velocimeter name="robot/velocity" site="robot/imu"/>
    <accelerometer name="robot/acceleration" site="robot/imu"/>
    <jointactuatorfrc name="robot/effort" joint="robot/elbow"/>
    <framequat name="robot/quat" objtype="site" objname="robot/imu"/>
    <framezaxis name="robot/up" objtype="body" objname="world" reftype="site" refname="robot/imu"/>
    <framepos name="robot/origin" objtype="body" objname="world" reftype="site" refname="robot/imu"/>
    <framepos name="robot/hand" objtype="site" objname="robot/hand"/>
    <framelinvel name="robot/hand_velocity" objtype="site" objname="robot/hand"/>
    <framepos name="robot/reach" objtype="site" objname="robot/hand" reftype="site" refname="robot/imu"/>
    <framequat name="robot/turn" objtype="site" objname="robot/hand" reftype="site" refname="robot/imu"/>
    <framelinvel name="robot/speed" objtype="site" objname="robot/hand" reftype="site" refname="robot/imu"/>
    <framepos name="robot/cube" objtype="xbody" objname="cube/cube" reftype="site" refname="robot/imu"/>
    <framequat name="cube/quat" objtype="body" objname="cube/cube"/>
    <framezaxis name="robot/cube_up" objtype="xbody" objname="cube/cube" reftype="xbody"
      refname="robot/base"/>
    <subtreeangmom name="robot/momentum" body="robot/base"/>
  </sensor>
</mujoco>"""


def subject(joint: str) -> Subject:
    model = mujoco.MjModel.from_xml_string(XML.format(joint=joint))
    robot = SimpleNamespace(is_fixed_base=not joint)
    scene = SimpleNamespace(entities={"robot": robot, "cube": SimpleNamespace(is_fixed_base=False)})
    env: Any = SimpleNamespace(sim=SimpleNamespace(mj_model=model), scene=scene)
    return Subject(env, "robot")


@pytest.mark.parametrize(
    ("name", "frame", "floating", "fixed"),
    [
        ("robot/gyro", "site robot/imu", "measured", "measured"),
        ("robot/acceleration", "site robot/imu", "measured", "measured"),
        ("robot/effort", "world", "measured", "measured"),
        ("robot/quat", "world", "measured", "computed"),
        ("robot/up", "site robot/imu", "measured", "computed"),
        ("robot/velocity", "site robot/imu", "estimated", "computed"),
        ("robot/origin", "site robot/imu", "estimated", "computed"),
        ("robot/hand", "world", "estimated", "computed"),
        ("robot/hand_velocity", "world", "estimated", "computed"),
        ("robot/reach", "site robot/imu", "computed", "computed"),
        ("robot/turn", "site robot/imu", "computed", "computed"),
        ("robot/speed", "site robot/imu", "computed", "computed"),
        ("robot/cube", "site robot/imu", "external", "external"),
        ("cube/quat", "world", "external", "external"),
        ("robot/cube_up", "body robot/base", "external", "external"),
        ("robot/momentum", "world", "none", "none"),
    ],
)
def test_sensor(name: str, frame: str, floating: str, fixed: str) -> None:
    freely, arm = sensor(subject("<freejoint/>"), name), sensor(subject(""), name)
    assert (freely.frame, freely.availability, arm.availability) == (frame, floating, fixed)


def test_every_type_of_sensor_is_known() -> None:
    kinds = [kind.removeprefix("mjSENS_").lower() for kind in mujoco.mjtSensor.__members__]
    unknown = [kind for kind in kinds if of_sensor(kind, True, False)[0] == "unknown"]
    assert unknown == ["plugin", "user"]


def test_computed_sensors_do_not_feel_the_root() -> None:
    """A robot cannot measure position and velocity of its root, and computes them without."""
    floating = subject("<freejoint/>")
    model, values = floating.model, []
    for place, velocity in ((0.0, 0.0), (3.0, 2.0)):
        data = mujoco.MjData(model)
        elbow = model.joint("robot/elbow")
        data.qpos[:3], data.qvel[:6] = place, velocity
        data.qpos[elbow.qposadr], data.qvel[elbow.dofadr] = 0.7, 1.5
        mujoco.mj_forward(model, data)
        names = [model.sensor(k).name for k in range(model.nsensor)]
        computed = [n for n in names if sensor(floating, n).availability == "computed"]
        values.append(np.concatenate([data.sensor(name).data for name in computed]))
    assert len(computed) == 3
    np.testing.assert_allclose(*values, atol=1e-12)


# One rule.


def scaled(env: ManagerBasedRlEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, 2)


def base_lin_vel(env: ManagerBasedRlEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, 3)


def test_describe_contract_and_check_agree(tmp_path) -> None:
    """Also on terms of packages, of which the name alone is known, or nothing."""
    task = "Mjlab-Lift-Cube-Yam"

    def edit(env: Any, agent: Any) -> None:
        terms = env.observations["actor"].terms
        terms["scaled"] = ObservationTermCfg(func=scaled)
        terms["own_velocity"] = ObservationTermCfg(func=base_lin_vel)

    cfg = load_env_cfg(task, evaluate=True)
    edit(cfg, None)
    rows = describe(task, DescribeConfig(env=cfg)).as_json()["unmeasured"]
    described = {row["term"] for row in rows if row["group"] == "actor"}
    assert described == {"ee_to_cube", "cube_to_goal", "own_velocity"}
    evidence = Evidence(write_random(task, tmp_path / "bundle", edit, steps=3))
    assert {one["term"] for one in evidence.contract["unmeasured"]} == described
    warned = [text for text in fitness_warnings(evidence) if text.startswith("Robots do not")]
    assert len(warned) == len(evidence.contract["unmeasured"])
