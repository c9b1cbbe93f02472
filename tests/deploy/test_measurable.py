"""Terms that a robot cannot measure are found in the tasks that observe them."""

from __future__ import annotations

import mujoco
import pytest

from mjlab.deploy.measurable import why_unmeasured
from mjlab.envs import mdp
from mjlab.managers import ObservationTermCfg
from mjlab.scripts.describe import describe


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


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="trunk"><freejoint/><geom size="0.1"/><site name="imu"/>
        <body><joint/><geom size="0.1"/><site name="hand"/></body></body></worldbody>
        <sensor><gyro name="gyro" site="imu"/><velocimeter name="velocimeter" site="imu"/>
        <framequat name="framequat" objtype="site" objname="imu"/>
        <framepos name="framepos" objtype="site" objname="hand"/>
        <framepos name="relative" objtype="site" objname="hand" reftype="site" refname="imu"/>
        <subtreeangmom name="angmom" body="trunk"/></sensor></mujoco>"""
    )


@pytest.mark.parametrize(
    ("sensor", "measured"),
    [
        ("gyro", True),
        ("framequat", True),
        ("relative", True),
        ("velocimeter", False),
        ("framepos", False),
        ("angmom", False),
    ],
)
def test_sensor_by_its_type(model: mujoco.MjModel, sensor: str, measured: bool) -> None:
    term = ObservationTermCfg(func=mdp.builtin_sensor, params={"sensor_name": sensor})
    assert (why_unmeasured(term, model) is None) == measured
