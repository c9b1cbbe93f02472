"""Trunk, feet, legs and hands, whatever they are called."""

from __future__ import annotations

import mujoco
import pytest
from legged import legged_spec
from small_robots import arm_spec

from mjlab.asset_zoo.robots.i2rt_yam.yam_constants import YAM_XML
from mjlab.asset_zoo.robots.unitree_g1.g1_constants import G1_XML
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import GO1_XML
from mjlab.own_robot.anatomy import find_anatomy
from mjlab.own_robot.model_source import name_elements


def anatomy_of(spec: mujoco.MjSpec, **options):
    name_elements(spec)
    return find_anatomy(spec.compile(), **options)


@pytest.mark.parametrize("legs", [2, 4, 6])
def test_feet_from_front_left_to_rear_right(legs):
    anatomy = anatomy_of(legged_spec(legs))
    end = "foot" if legs == 2 else "calf"
    expected = [f"{side}{row}_{end}" for row in range(legs // 2) for side in "ab"]
    assert anatomy.kind.value == "legged"
    assert [foot.link for foot in anatomy.feet.value] == expected
    assert anatomy.trunk.value == "trunk"


@pytest.mark.parametrize("legs", [4, 6])
def test_feet_of_a_row_need_not_be_level(legs):
    spec = legged_spec(legs)
    for number in range(legs):
        row, side = divmod(number, 2)
        # As CAD has it, 0.1 mm; feet apart by a tenth of the trunk too.
        for shift in (1e-4, 0.03):
            spec.body(f"{'ab'[side]}{row}_hip").pos[0] += shift * (-1) ** number
    links = [foot.link for foot in anatomy_of(spec).feet.value]
    assert links == [f"{side}{row}_calf" for row in range(legs // 2) for side in "ab"]


def test_sole_is_the_lowest_geom():
    calf = anatomy_of(legged_spec(4)).feet.value[0]
    assert calf.sole == ("a0_calf_collision2",)
    assert calf.position == pytest.approx((0, 0, -0.22), abs=0.01)
    foot = anatomy_of(legged_spec(2)).feet.value[0]
    assert foot.size == pytest.approx((0.18, 0.08), abs=1e-6)


def test_waist_is_no_joint_of_a_leg():
    # The legs hang on a pelvis below a torso that has the free joint.
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody><body name="torso"><freejoint/>
      <geom type="box" size=".1 .1 .1"/>
      <body name="pelvis" pos="0 0 -.2"><joint name="waist" axis="0 0 1"/><geom size=".05"/>
        <body name="left" pos="0 .1 0"><joint name="left_hip" axis="0 1 0"/>
          <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4"/></body>
        <body name="right" pos="0 -.1 0"><joint name="right_hip" axis="0 1 0"/>
          <geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4"/></body>
      </body></body></worldbody></mujoco>""")
    legs = anatomy_of(spec).legs.value
    assert [leg.joints for leg in legs] == [("left_hip",), ("right_hip",)]


def test_torso_above_a_waist_is_kept_upright():
    assert anatomy_of(legged_spec(2, waist=True)).upright.value == "torso"
    assert anatomy_of(legged_spec(4, waist=True)).upright.value == "trunk"


def test_hands_of_a_humanoid_are_no_feet():
    anatomy = anatomy_of(legged_spec(2, waist=True))
    assert {foot.link for foot in anatomy.feet.value} == {"a0_foot", "b0_foot"}


@pytest.mark.parametrize("legs", [2, 4, 6])
def test_mirror_is_an_involution(legs):
    mirror = anatomy_of(legged_spec(legs, waist=True)).mirror.value
    assert len(mirror) == legs * (4 if legs == 2 else 3) + 3
    for joint, (partner, sign) in mirror.items():
        assert mirror[partner] == (joint, sign)
    assert mirror["a0_1"] == ("b0_1", -1.0)
    assert mirror["a0_2"] == ("b0_2", 1.0)
    assert mirror["turn"] == ("turn", -1.0)


def test_toes_point_to_the_front():
    assert anatomy_of(legged_spec(2)).front.value == 1.0
    spec = legged_spec(2)
    for side in "ab":
        spec.body(f"{side}0_foot").first_geom().pos = (-0.03, 0, -0.02)
    front = anatomy_of(spec).front
    assert (front.value, front.source) == (-1.0, "asked")


def test_falls_are_all_but_feet_and_ankles():
    falls = anatomy_of(legged_spec(2)).fall_bodies.value
    assert set(falls) == {
        "trunk",
        *(f"{side}0_{part}" for side in "ab" for part in ("thigh", "calf")),
    }


def test_stock_robots():
    go1, g1, yam = (
        anatomy_of(mujoco.MjSpec.from_file(str(file))) for file in (GO1_XML, G1_XML, YAM_XML)
    )
    assert [foot.sole for foot in go1.feet.value] == [
        (f"{foot}_foot_collision",) for foot in ("FL", "FR", "RL", "RR")
    ]
    assert g1.imu_site.value == "imu_in_pelvis"
    assert g1.upright.value == "torso_link"
    (hand,) = yam.hands.value
    assert (hand.link, hand.site, len(hand.joints)) == ("link_6", "grasp_site", 6)
    assert hand.gripper == ("left_finger", "right_finger")
    assert not yam.mirror.value


def test_actuators():
    spec = arm_spec()
    spec.delete(spec.actuator("servo0"))
    motor = spec.actuator("servo1")
    motor.set_to_motor()
    drives = anatomy_of(spec).drives.value
    assert [drives[f"joint{n}"] for n in range(3)] == ["none", "motor", "position"]


def test_imu_of_the_gyro_before_that_of_a_name():
    spec = legged_spec(4)
    trunk = spec.body("trunk")
    trunk.add_site(name="imu")
    trunk.add_site(name="sensor")
    assert anatomy_of(spec.copy()).imu_site.value == "imu"
    spec.add_sensor(
        name="gyro",
        type=mujoco.mjtSensor.mjSENS_GYRO,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="sensor",
    )
    assert anatomy_of(spec).imu_site.value == "sensor"


def test_planar_walker_is_no_arm():
    spec = arm_spec()
    for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1))):
        spec.body("base").add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    assert anatomy_of(arm_spec()).kind.value == "arm"
    assert anatomy_of(spec).kind.value == "other"
