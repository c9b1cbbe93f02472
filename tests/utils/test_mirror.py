"""Left-right partners by geometry."""

from __future__ import annotations

import mujoco
import pytest

from mjlab.asset_zoo.robots.unitree_g1.g1_constants import get_spec as g1_spec
from mjlab.asset_zoo.robots.unitree_go1.go1_constants import get_spec as go1_spec
from mjlab.utils.mirror import describe_unpaired, mirror_elements, mirror_pairs

LEG = """
<body name="{hip}" pos="{x} {y} 0"><joint name="{hip}" axis="1 0 0" range="{range}"/>
  <geom size=".02" pos="0 {out} 0"/>
  <body name="{knee}" pos="0 {out} -.2"><joint name="{knee}" axis="0 1 0" range="-2 0"/>
    <geom name="{knee}" type="capsule" size=".02" fromto="0 0 0 0 0 -.2"/>
    <site name="{knee}" pos="0 0 -.2"/></body></body>
"""


def model_of(*bodies, root='<freejoint/><geom size=".1"/>'):
    inside = "".join(bodies)
    return mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><worldbody>'
        f'<body name="trunk" pos="0 0 1" euler="0 0 1">{root}{inside}</body></worldbody></mujoco>'
    )


def leg(side, x, y, hip="{}_hip", knee="{}_knee", out=None, limits=(-0.5, 1.0)):
    """Leg at (x, y) whose knee is `out` (m) to the left of its hip."""
    limits = limits if y > 0 else (-limits[1], -limits[0])
    return LEG.format(
        hip=hip.format(side),
        knee=knee.format(side),
        x=x,
        y=y,
        out=0.05 * (1 if y > 0 else -1) if out is None else out,
        range="{} {}".format(*limits),
    )


def four_legs(sides, **keywords):
    places = ((0.3, 0.1), (0.3, -0.1), (-0.3, 0.1), (-0.3, -0.1))
    return [leg(side, x, y, **keywords) for side, (x, y) in zip(sides, places, strict=True)]


def named(model, found):
    return {
        model.joint(i).name: (model.joint(partner.joint).name, partner.sign)
        for i, partner in found.items()
    }


@pytest.mark.parametrize(
    "sides",
    [
        ("FL", "FR", "RL", "RR"),
        ("lf", "rf", "lh", "rh"),
        ("fl", "fr", "hl", "hr"),
        ("Left_front", "Right_front", "Left_hind", "Right_hind"),
        ("leg_1", "leg_2", "leg_3", "leg_4"),
        ("LL", "LR", "KL", "KR"),
        ("un", "deux", "trois", "quatre"),
    ],
)
def test_partners_do_not_depend_on_names(sides):
    model = model_of(*four_legs(sides))
    left, right, hind_left, hind_right = sides
    found = named(model, mirror_pairs(model))
    for a, b in ((left, right), (hind_left, hind_right)):
        for one, other in ((a, b), (b, a)):
            assert found[f"{one}_hip"] == (f"{other}_hip", -1.0)
            assert found[f"{one}_knee"] == (f"{other}_knee", 1.0)
    assert len(found) == 8
    assert not describe_unpaired(model)


@pytest.mark.parametrize("get_spec", [go1_spec, g1_spec])
def test_partners_of_stock_robots_are_those_of_their_names(get_spec):
    model = get_spec().compile()
    other = {"left": "right", "right": "left", "FL": "FR", "FR": "FL", "RL": "RR", "RR": "RL"}
    found = named(model, mirror_pairs(model))
    assert len(found) == model.njnt - 1
    for name, (partner, sign) in found.items():
        assert partner == "_".join(other.get(part, part) for part in name.split("_"))
        # Sideways and turning joints are reversed.
        assert sign == (-1.0 if any(k in name for k in ("roll", "yaw", "hip_joint")) else 1.0)


def test_partners_are_mutual():
    model = g1_spec().compile()
    found = mirror_pairs(model)
    for joint, (partner, sign) in found.items():
        assert found[partner] == (joint, sign)


def test_central_joint_is_its_own_partner():
    waist = (
        '<body name="waist"><joint name="waist" axis="0 0 1"/><geom size=".1" pos="0 0 .2"/></body>'
    )
    model = model_of(*four_legs("abcd"), waist)
    assert named(model, mirror_pairs(model))["waist"] == ("waist", -1.0)


def test_slide_is_mirrored_as_a_direction():
    slide = (
        '<body pos="0 {y} 0"><joint name="{n}" type="slide" axis="0 1 0"/><geom size=".1"/></body>'
    )
    model = model_of(slide.format(y=0.1, n="a"), slide.format(y=-0.1, n="b"))
    assert named(model, mirror_pairs(model)) == {"a": ("b", -1.0), "b": ("a", -1.0)}


def test_anchor_may_lie_anywhere_on_the_axis():
    arm = '<body pos="0 .2 .3"><joint name="lift" axis="0 1 0"/><geom size=".1" pos="0 -.2 0"/></body>'
    model = model_of(arm)
    assert named(model, mirror_pairs(model)) == {"lift": ("lift", 1.0)}


def test_wheels_on_one_axle_are_partners():
    wheel = '<body pos="0 {y} 0"><joint name="{n}" axis="0 1 0"/><geom size=".1"/></body>'
    model = model_of(wheel.format(y=0.2, n="a"), wheel.format(y=-0.2, n="b"))
    assert named(model, mirror_pairs(model)) == {"a": ("b", 1.0), "b": ("a", 1.0)}


def test_names_decide_where_geometry_does_not():
    """Legs of a planar walker lie in the mirror plane."""
    model = model_of(leg("left", 0, 1e-6, out=0), leg("right", 0, -1e-6, out=0))
    assert named(model, mirror_pairs(model))["left_knee"] == ("right_knee", 1.0)


def test_ranges_decide_before_names():
    sides = [leg(s, 0, y, out=0, limits=r) for s, y, r in (
        ("left", 1e-6, (-0.5, 1.0)), ("right", 1e-6, (-0.2, 0.3)),
        ("c", -1e-6, (-0.5, 1.0)), ("d", -1e-6, (-0.2, 0.3)),
    )]  # fmt: skip
    found = named(model := model_of(*sides), mirror_pairs(model))
    assert found["left_hip"] == ("c_hip", -1.0)
    assert found["right_hip"] == ("d_hip", -1.0)


@pytest.mark.parametrize("prefix", ["", "robot/"])
def test_pairs_replace_geometry(prefix):
    model = model_of(*four_legs("abcd"))
    pairs = {f"{prefix}a_knee": f"{prefix}d_knee", "c_knee": "b_knee"}
    found = named(model, mirror_pairs(model, pairs=pairs))
    assert found["a_knee"] == ("d_knee", 1.0)
    assert found["d_knee"] == ("a_knee", 1.0)
    assert found["c_knee"] == ("b_knee", 1.0)
    assert found["a_hip"] == ("b_hip", -1.0)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [({"a_hip": "x"}, "'x'.*a_knee"), ({"a_hip": "b_knee"}, "'a_hip', 'b_knee'.*parallel")],
)
def test_wrong_pairs_are_named(pairs, message):
    model = model_of(*four_legs("abcd"))
    with pytest.raises(ValueError, match=message):
        mirror_pairs(model, pairs=pairs)


def test_joint_without_image_is_described():
    model = model_of(leg("a", 0.3, 0.1), leg("b", 0.33, -0.1))
    # The axes of the hips, along x, are mirror images all the same.
    assert set(named(model, mirror_pairs(model))) == {"a_hip", "b_hip"}
    described = describe_unpaired(model)
    assert set(described) == {model.joint("a_knee").id, model.joint("b_knee").id}
    assert "closest b_knee: axis off by 30 mm" in described[model.joint("a_knee").id]


def test_two_arms_on_the_ground_are_mirrored_in_the_world():
    arm = (
        '<body pos="0 {y} 0"><joint name="{n}" axis="0 0 1"/><geom size=".1" pos=".2 0 0"/></body>'
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{arm.format(y=0.2, n='a')}{arm.format(y=-0.2, n='b')}</worldbody></mujoco>"
    )
    assert named(model, mirror_pairs(model)) == {"a": ("b", -1.0), "b": ("a", -1.0)}


@pytest.mark.parametrize("kind", ["body", "site", "geom"])
def test_elements_follow_the_joints_that_move_them(kind):
    model = model_of(*four_legs("abcd"))
    ids = [getattr(model, kind)(f"{side}_knee").id for side in "dbac"]
    found = mirror_elements(model, kind, ids)
    d, b, a, c = ids
    assert found == {d: c, b: a, a: b, c: d}
    assert mirror_elements(model, kind, [a, c]) == {}
    crossed = mirror_elements(model, kind, ids, pairs={"a_knee": "d_knee", "b_knee": "c_knee"})
    assert crossed == {d: a, b: c, a: d, c: b}


def test_element_of_the_trunk_is_its_own_image():
    root = '<freejoint/><geom size=".1"/><site name="imu" pos="-.1 0 0"/><site name="side" pos="0 .1 0"/>'
    model = model_of(*four_legs("abcd"), root=root)
    imu, side = model.site("imu").id, model.site("side").id
    assert mirror_elements(model, "site", [imu, side]) == {imu: imu}
