"""Overflow of Warp's capacities is reported with the size to set."""

from __future__ import annotations

import logging
import re

import mujoco
import pytest

from mjlab.sim.config import SimulationCfg
from mjlab.sim.warp.engine import WarpEngine
from mjlab.sim.warp.overflow import SIZES

# Twelve contacts per environment, four per box.
BOXES = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="a" pos="0 0 .049"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
    <body name="b" pos="1 0 .049"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
    <body name="c" pos="2 0 .049"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
  </worldbody>
  <sensor><contact geom1="floor" num="16" reduce="none" data="found force"/></sensor>
</mujoco>
"""
AIRBORNE = BOXES.replace(".049", ".5")


def make_engine(xml: str, **sizes: int) -> WarpEngine:
    model = mujoco.MjModel.from_xml_string(xml)
    return WarpEngine(model, 2, SimulationCfg(engine="warp", **sizes), "cpu")


def land(engine: WarpEngine) -> None:
    engine.data_field("qpos")[:, 2::7] = 0.049
    engine.step(1)


def test_the_case_has_twelve_contacts() -> None:
    engine = make_engine(BOXES)
    land(engine)
    assert engine.data_field("sensordata")[0, 0] == 12


# One size is too small for the contacts after landing; the others are ample.
@pytest.mark.parametrize("option", SIZES)
def test_an_overflow_names_a_size_that_is_enough(
    option: str, caplog: pytest.LogCaptureFixture
) -> None:
    ample = {"njmax": 128, "nconmax": 32, "contact_sensor_maxmatch": 64}
    small = {"njmax": 10, "nconmax": 5, "contact_sensor_maxmatch": 3}
    engine = make_engine(AIRBORNE, **{**ample, option: small[option]})
    with caplog.at_level(logging.WARNING):
        land(engine)
    messages = [record.getMessage() for record in caplog.records]
    named = [text for text in messages if f"Set SimulationCfg.{option} to " in text]
    assert named, messages
    assert all(f"{option}={small[option]}" in text for text in named)
    advised = re.search(rf"SimulationCfg\.{option} to (\d+)", named[0])
    assert advised is not None
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        engine = make_engine(AIRBORNE, **{**ample, option: int(advised.group(1))})
        land(engine)
        engine.close()
    assert not caplog.records


def test_an_overflow_that_is_over_is_still_reported(caplog: pytest.LogCaptureFixture) -> None:
    engine = make_engine(AIRBORNE, contact_sensor_maxmatch=3)
    engine.step(1)
    land(engine)
    engine.data_field("qpos")[:, 2::7] = 0.5
    engine.step(1)
    assert not caplog.records, "flags are checked only periodically"
    with caplog.at_level(logging.WARNING):
        engine.close()
    # The size needed at the overflow is no longer known.
    assert "SimulationCfg.contact_sensor_maxmatch to 8, and more if" in caplog.text
