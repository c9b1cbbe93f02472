"""Standing poses stand."""

from __future__ import annotations

import mujoco
import pytest
from legged import legged_spec

from mjlab.own_robot import geometry as geo
from mjlab.own_robot.anatomy import find_anatomy
from mjlab.own_robot.model_source import name_elements
from mjlab.own_robot.posture import check_pose, find_posture, knee_forward

ROBOTS = {
    "biped": {"legs": 2},
    "humanoid": {"legs": 2, "waist": True},
    "quadruped": {"legs": 4},
    "hexapod": {"legs": 6},
}


def posed(spec: mujoco.MjSpec, **options):
    name_elements(spec)
    model = spec.compile()
    anatomy = find_anatomy(model)
    return model, anatomy, find_posture(model, anatomy, **options)


@pytest.mark.parametrize("robot", ROBOTS)
def test_searched_pose_passes_the_checks(robot):
    model, anatomy, posture = posed(legged_spec(**ROBOTS[robot]))
    assert posture.joint_pos.source == "rule"
    assert check_pose(model, anatomy, posture.joint_pos.value, posture.leg_length) == []
    assert 0.7 < posture.root_height.value / posture.leg_length < 0.95


@pytest.mark.parametrize("robot", ROBOTS)
def test_lowest_geom_touches_the_ground(robot):
    spec = legged_spec(**ROBOTS[robot])
    _, _, posture = posed(spec)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1))
    model = spec.compile()
    data = mujoco.MjData(model)
    geo.set_pose(model, data, posture.joint_pos.value, posture.root_height.value)
    floor = model.geom("floor").id
    others = [g for g in range(model.ngeom) if g != floor and model.geom_contype[g]]
    distances = [mujoco.mj_geomDistance(model, data, floor, g, 5.0, None) for g in others]
    assert min(distances) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("robot", ROBOTS)
def test_pose_is_its_own_mirror_image(robot):
    _, anatomy, posture = posed(legged_spec(**ROBOTS[robot]))
    pose = posture.joint_pos.value
    for joint, (partner, sign) in anatomy.mirror.value.items():
        assert pose[partner] == pytest.approx(sign * pose[joint], abs=1e-4)


def with_keyframe(hip: float, knee: float) -> mujoco.MjSpec:
    spec = legged_spec(4)
    spec.add_key(name="home", qpos=[0, 0, 0.4, 1, 0, 0, 0] + 4 * [0.0, hip, knee])
    return spec


def test_keyframe_that_stands_is_taken():
    _, _, posture = posed(with_keyframe(0.8, -1.6))
    assert posture.joint_pos.source == "file"
    assert posture.joint_pos.value["a0_3"] == -1.6


@pytest.mark.parametrize(
    ("hip", "knee", "fault"),
    [(0.0, -2.9, "outside"), (2.4, -0.4, "trunk"), (-0.9, -0.3, "center of mass")],
)
def test_keyframe_that_does_not_stand(hip, knee, fault):
    model, anatomy, posture = posed(with_keyframe(hip, knee))
    assert posture.joint_pos.source == "rule"
    keyframe = {
        f"{s}{r}_{n}": q for s in "ab" for r in (0, 1) for n, q in ((1, 0), (2, hip), (3, knee))
    }
    faults = check_pose(model, anatomy, keyframe, posture.leg_length)
    assert any(fault in text for text in faults)


def test_knee_that_bends_both_ways_is_asked():
    model, anatomy, posture = posed(legged_spec(4, knee=(-2.5, 2.5)))
    assert posture.joint_pos.source == "asked"
    # One question a row: left and right bend alike.
    assert {question.key for question in posture.questions} == {"pose.a0_3", "pose.a1_3"}
    pose = posture.joint_pos.value
    assert not any(knee_forward(model, anatomy, leg, pose) for leg in anatomy.legs.value)


def test_answered_knee():
    answers = {f"{side}{row}_3": 1.2 for side in "ab" for row in (0, 1)}
    model, anatomy, posture = posed(legged_spec(4, knee=(-2.5, 2.5)), answers=answers)
    pose = posture.joint_pos.value
    assert pose["a1_3"] == 1.2
    assert posture.questions == ()
    assert all(knee_forward(model, anatomy, leg, pose) for leg in anatomy.legs.value)
    assert check_pose(model, anatomy, pose, posture.leg_length) == []


def test_tendon_limits_are_kept():
    spec = legged_spec(2)
    for side in "ab":
        tendon = spec.add_tendon(name=f"{side}_hamstring", limited=True, range=(-0.4, 2.0))
        tendon.wrap_joint(f"{side}0_2", 1.0)
    model, anatomy, posture = posed(spec)
    data = mujoco.MjData(model)
    geo.set_pose(model, data, posture.joint_pos.value)
    assert geo.tendon_excess(model, data).max() < 0.05
