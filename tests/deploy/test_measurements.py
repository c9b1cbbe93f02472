"""Sensors: frame and availability."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import pytest

from mjlab.deploy.measurements import Subject, sensor

XML = """<mujoco>
  <worldbody>
    <body name="robot/base"><freejoint/><geom size=".1"/><site name="robot/imu"/></body>
    <body name="cube/cube" pos="1 0 0"><freejoint/><geom size=".1"/></body>
  </worldbody>
  <sensor>
    <gyro name="robot/gyro" site="robot/imu"/>
    <framequat name="robot/quat" objtype="site" objname="robot/imu"/>
    <framezaxis name="robot/up" objtype="body" objname="world" reftype="site" refname="robot/imu"/>
    <framequat name="cube/quat" objtype="body" objname="cube/cube"/>
    <framezaxis name="robot/cube_up" objtype="xbody" objname="cube/cube" reftype="xbody"
      refname="robot/base"/>
  </sensor>
</mujoco>"""


@pytest.mark.parametrize(
    ("name", "frame", "body", "availability"),
    [
        ("robot/gyro", "site robot/imu", "robot/base", "measured"),
        ("robot/quat", "world", "robot/base", "measured"),
        ("robot/up", "site robot/imu", "world", "measured"),
        ("cube/quat", "world", "cube/cube", "external"),
        ("robot/cube_up", "body robot/base", "cube/cube", "external"),
    ],
)
def test_frame_and_availability_of_a_sensor(name, frame, body, availability):
    model = mujoco.MjModel.from_xml_string(XML)
    env: Any = SimpleNamespace(sim=SimpleNamespace(mj_model=model))
    found = sensor(Subject(env, "robot"), name)
    assert (found.frame, found.source["body"], found.availability) == (frame, body, availability)
