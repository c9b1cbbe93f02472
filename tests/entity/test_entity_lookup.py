"""Lookup of entity elements by regular expression."""

from __future__ import annotations

import pytest

from mjlab.actuator import BuiltinMotorActuatorCfg, TransmissionType
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg

EVERYTHING = """
<mujoco>
  <asset>
    <texture name="wood" type="2d" builtin="flat" width="4" height="4"/>
    <texture name="sky" type="skybox" builtin="flat" width="4" height="4"/>
    <material name="wood_m" texture="wood"/><material name="steel"/>
  </asset>
  <worldbody>
    <body name="base"><freejoint/>
      <geom name="g_base" size=".1"/><camera name="front"/><camera name="rear"/>
      <light name="lamp"/><light name="torch"/><site name="s1"/><site name="s2"/>
      <body name="left"><joint name="left_hip"/><geom name="g_left" size=".1"/></body>
      <body name="right"><joint name="right_hip"/><geom name="g_right" size=".1"/></body>
    </body>
  </worldbody>
  <contact><pair name="p1" geom1="g_left" geom2="g_right"/>
    <pair name="p2" geom1="g_base" geom2="g_right"/></contact>
  <tendon><spatial name="t1"><site site="s1"/><site site="s2"/></spatial>
    <fixed name="t2"><joint joint="left_hip" coef="1"/></fixed></tendon>
  <actuator><motor name="m1" joint="left_hip"/><motor name="m2" joint="right_hip"/></actuator>
</mujoco>
"""

KINDS = {
    "joints": ("left_hip", "right_hip"),
    "geoms": ("g_base", "g_left", "g_right"),
    "sites": ("s1", "s2"),
    "tendons": ("t1", "t2"),
    "cameras": ("front", "rear"),
    "lights": ("lamp", "torch"),
    "materials": ("wood_m", "steel"),
    "textures": ("wood", "sky"),
    "pairs": ("p1", "p2"),
    "actuators": ("m1", "m2"),
}


@pytest.fixture(scope="module", params=["alone", "in a scene"])
def entity(request):
    """Names are the same before and after a scene has put its prefix in front."""
    import mujoco

    from mjlab.scene import Scene, SceneCfg

    cfg = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(EVERYTHING))
    if request.param == "alone":
        return cfg.build()
    return Scene(SceneCfg(entities={"first": cfg, "robot": cfg}), "cpu")["robot"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_found_in_order_or_by_pattern(entity, kind):
    names = KINDS[kind]
    find = getattr(entity, f"find_{kind}")
    assert getattr(entity, f"{kind[:-1]}_names") == names
    assert getattr(entity, f"num_{kind}") == len(names)
    everything = list(range(len(names)))
    assert find(".*") == (everything, list(names))
    assert find(names[::-1]) == (everything, list(names)), "the entity's order"
    expected = (everything[::-1], list(names[::-1]))
    assert find(names[::-1], preserve_order=True) == expected
    subset = {f"{kind[:-1]}_subset": list(names[::-1])}
    assert find(names[-1], **subset) == ([0], [names[-1]]), "indices count in the subset"


def test_bodies_exclude_the_world(entity):
    assert entity.find_bodies(".*")[1] == ["base", "left", "right"]
    assert entity.num_bodies == 3
    assert entity.find_bodies(("right", "base"), preserve_order=True) == ([2, 0], ["right", "base"])


def test_a_pattern_must_match_a_whole_name(entity):
    with pytest.raises(ValueError) as caught:
        entity.find_joints(("left", "right_hip"))
    text = str(caught.value)
    assert "('left', 'right_hip') do not resolve to joints" in text
    assert "['left']" in text
    assert "['left_hip', 'right_hip']" in text


def test_a_name_matched_by_two_patterns_is_an_error(entity):
    with pytest.raises(ValueError, match="'left_hip' is matched by several patterns"):
        entity.find_joints((".*_hip", "left.*"))


def test_actuated_joints_are_found_by_their_own_names(kit):
    articulation = EntityArticulationInfoCfg(
        actuators=(
            BuiltinMotorActuatorCfg(target_names_expr=("elbow",), effort_limit=1.0),
            BuiltinMotorActuatorCfg(
                target_names_expr=("cable",),
                transmission_type=TransmissionType.TENDON,
                effort_limit=1.0,
            ),
        )
    )
    arm = kit.cfg(kit.ARM, articulation=articulation).build()
    assert arm.find_joints_by_actuator_names(".*") == ([1], ["elbow"])
    with pytest.raises(ValueError, match=r"'shoulder'.*actuated joints(.|\n)*\['elbow'\]"):
        arm.find_joints_by_actuator_names("shoulder")
