"""Tests of contact sensor patterns, secondaries, and errors at build time."""

from __future__ import annotations

import logging

import mujoco
import pytest

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import BuiltinSensorCfg, ContactMatch, ContactSensorCfg

from .contact_scenes import BOX, LEGS, TERRAIN, body, compose, geom, sense, simulate, subtree


def elements(scene: Scene) -> list[tuple[str, str]]:
    """Return object and reference of the MuJoCo sensors of `touch`."""
    return [
        (sensor.objname, sensor.refname)
        for sensor in scene.spec.sensors
        if sensor.name.startswith("touch_")
    ]


def robot(primary: ContactMatch, secondary: ContactMatch | None = None, **fields) -> Scene:
    return compose(sense(primary, secondary, **fields), robot=LEGS)


# Primaries.


def test_primaries_have_the_order_of_the_spec():
    scene = robot(geom(("right_.*", "left_shin"), "robot"))
    assert scene["touch"].primary_names == ["left_shin", "right_foot", "right_shin"]
    assert elements(scene)[0] == ("robot/left_shin", "")


def test_bodies_and_subtrees_are_matched_among_bodies():
    for match, kind in ((body, mujoco.mjtObj.mjOBJ_BODY), (subtree, mujoco.mjtObj.mjOBJ_XBODY)):
        scene = robot(match("left|trunk", "robot"))
        assert scene["touch"].primary_names == ["trunk", "left"]
        assert {sensor.objtype for sensor in scene.spec.sensors} == {kind}


def test_exclude_takes_names_and_patterns():
    names = robot(geom(".*", "robot", exclude=("^right_", "left_shin")))["touch"].primary_names
    assert names == ["trunk_collision", "left_foot"]
    # Without special characters, "shin" is a whole name, which none is.
    assert len(robot(geom(".*", "robot", exclude=("shin",)))["touch"].primary_names) == 5


def test_without_an_entity_names_are_literal_and_in_the_order_given():
    scene = robot(geom(("robot/right_foot", "robot/left_foot"), None))
    assert scene["touch"].primary_names == ["robot/right_foot", "robot/left_foot"]
    with pytest.raises(ValueError, match=r"'robot/.\*_foot'.*literal"):
        robot(geom("robot/.*_foot", None))
    with pytest.raises(ValueError, match=r"distinct.*'robot/left_foot', 'robot/left_foot'"):
        robot(geom(("robot/left_foot", "robot/left_foot"), None))


def test_the_terrain_is_an_entity_too():
    for match in (body("terrain", "terrain"), geom("ter.*", "terrain"), TERRAIN):
        scene = robot(geom("left_foot", "robot"), match)
        assert elements(scene) == [("robot/left_foot", "terrain")]
        assert compose(sense(match), robot=LEGS)["touch"].primary_names == ["terrain"]


def test_attached_names_may_be_short_or_full():
    arm = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='elbow'><joint name='j'/><geom name='tip' size='.1'/></body>"
        "</worldbody></mujoco>"
    )

    def make() -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        base = spec.worldbody.add_body(name="base")
        base.add_freejoint()
        base.add_geom(name="hull", size=[0.1, 0, 0])
        for side in ("left", "right"):
            spec.attach(arm.copy(), prefix=f"{side}/", frame=base.add_frame())
        return spec

    def build(match: ContactMatch) -> Scene:
        scene = Scene(
            SceneCfg(entities={"r": EntityCfg(spec_fn=make)}, sensors=(sense(match),)), "cpu"
        )
        simulate(scene)
        return scene

    scene = build(geom("tip", "r"))
    assert scene["touch"].primary_names == ["left/tip", "right/tip"]
    assert elements(scene) == [("r/left/tip", ""), ("r/right/tip", "")]
    assert scene["touch"].data.found.shape == (1, 2)
    assert build(body("right/elbow", "r"))["touch"].primary_names == ["right/elbow"]
    assert build(geom(".*tip", "r", exclude=("left/tip",)))["touch"].primary_names == ["right/tip"]


def test_elements_without_a_name_are_not_passed_over_in_silence(caplog):
    xml = BOX.replace("</body>", "<geom size='.1'/></body>")
    with caplog.at_level(logging.WARNING):
        assert compose(sense(geom(".*")), box=xml)["touch"].primary_names == ["box"]
    assert "1 unnamed geoms of entity 'box'" in caplog.text


# Secondaries.


def test_the_policy_decides_about_several_secondaries():
    feet = geom(".*_foot", "robot")
    primary = geom("trunk_collision", "robot")
    assert elements(robot(primary, feet))[0][1] == "robot/left_foot"
    assert elements(robot(primary, feet, secondary_policy="any"))[0][1] == ""
    for policy in ("error", "last"):
        with pytest.raises(ValueError, match=r"secondary.*\['left_foot', 'right_foot'\]"):
            robot(primary, feet, secondary_policy=policy)
    assert elements(robot(primary, geom("left_foot", "robot"), secondary_policy="error"))


def test_a_secondary_may_have_several_patterns():
    primary = geom("trunk_collision", "robot")
    feet = geom(("right_foot", "left_foot"), "robot")
    assert elements(robot(primary, feet))[0][1] == "robot/left_foot"
    assert elements(robot(primary, feet, secondary_policy="any"))[0][1] == ""
    with pytest.raises(ValueError, match=r"secondary.*\['left_foot', 'right_foot'\]"):
        robot(primary, feet, secondary_policy="error")


def test_a_secondary_subtree_is_named_in_its_entity():
    scene = robot(subtree("trunk", "robot"), subtree("trunk", "robot"))
    assert elements(scene) == [("robot/trunk", "robot/trunk")]


# Mistakes.


@pytest.mark.parametrize(
    ("match", "message"),
    [
        (geom("left_fot", "robot"), "'left_fot' matches none .* 'left_foot'"),
        (body("left_foot", "robot"), r"none of the bodies .*\['trunk', 'left', 'right'\]"),
        (geom("left_foot", "robt"), "entity 'robt'.*mean 'robot'.*'terrain'"),
        (geom("robot/left_fot", None), "'robot/left_fot' .* mean 'robot/left_foot'"),
        (geom(".*", "robot", exclude=(".*",)), r"exclude=.*'\.\*'"),
        (geom("(", "robot"), "not a valid regular expression"),
    ],
)
@pytest.mark.parametrize("role", ["primary", "secondary"])
def test_a_sensor_that_matches_nothing_is_refused_with_close_names(match, message, role):
    other = geom("trunk_collision", "robot")
    with pytest.raises(ValueError, match=message):
        robot(match) if role == "primary" else robot(other, match)


def test_every_pattern_has_to_match_and_no_name_twice():
    with pytest.raises(ValueError, match="'hand' matches none of the geoms of entity 'robot'"):
        robot(geom(("left_foot", "hand"), "robot"))
    with pytest.raises(ValueError, match="'left_.*' and '.*_foot' both match 'left_foot'"):
        robot(geom(("left_.*", ".*_foot"), "robot"))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"fields": ("found", "forces")}, "fields.*'found', 'force', 'torque'.*'forces'"),
        ({"reduce": "sum"}, "reduce.*'none', 'mindist', 'maxforce', 'netforce'.*'sum'"),
        (
            {"primary": ContactMatch("joint", "box")},
            "primary mode.*'geom', 'body', 'subtree'.*'joint'",
        ),
    ],
)
def test_unknown_words_list_the_known(fields, message):
    cfg = ContactSensorCfg(**{"name": "feet", "primary": geom("box"), **fields})
    with pytest.raises(ValueError, match=f"Contact sensor 'feet'.*{message}"):
        compose(cfg, box=BOX)


@pytest.mark.parametrize("pattern", ["", (), ("left_foot", "")])
def test_an_empty_pattern_may_be_filled_in_until_the_scene_is_built(pattern):
    cfg = sense(ContactMatch("geom", pattern, "robot"), ContactMatch("geom", pattern, "robot"))
    with pytest.raises(ValueError, match="primary pattern: expected at least one name"):
        compose(cfg, robot=LEGS)
    cfg.primary.pattern = ("left_foot", "right_foot")
    with pytest.raises(ValueError, match="secondary pattern: expected at least one name"):
        compose(cfg, robot=LEGS)
    assert cfg.secondary is not None
    cfg.secondary.pattern = "trunk_collision"
    feet = ["robot/left_foot", "robot/right_foot"]
    assert elements(compose(cfg, robot=LEGS)) == [(foot, "robot/trunk_collision") for foot in feet]


def test_name_of_a_primary_may_be_a_sensor():
    longer = sense(geom("box"))
    longer.name = "touch_box"
    scene = compose(sense(geom("box")), longer, box=BOX)
    assert scene["touch"].primary_names == scene["touch_box"].primary_names == ["box"]


def test_two_sensors_of_one_name_are_refused():
    with (
        pytest.warns(UserWarning, match="SceneCfg.sensors.*'touch'"),
        pytest.raises(ValueError, match="'touch'.*already has MuJoCo sensors"),
    ):
        compose(sense(geom("box")), sense(body("box")), box=BOX)


def test_a_name_that_the_scene_has_already_is_refused():
    clock = BuiltinSensorCfg(name="touch_box", sensor_type="clock")
    with pytest.raises(ValueError, match=r"already has MuJoCo sensors .*\['touch_box'\]"):
        compose(clock, sense(geom("box")), box=BOX)
    # As the key of the scene, the name would hide the sensor of the XML.
    gyro = BOX.replace("</worldbody>", "</worldbody><sensor><clock name='tick'/></sensor>")
    cfg = sense(geom("box"))
    cfg.name = "box/tick"
    with pytest.raises(ValueError, match=r"\['box/tick'\]"):
        compose(cfg, box=gyro)


def test_of_many_names_a_few_are_listed():
    boxes = "".join(f'<geom name="box_{k}" size=".1"/>' for k in range(200))
    many = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(
            f'<mujoco><worldbody><body name="pile"><freejoint/>{boxes}</body></worldbody></mujoco>'
        )
    )
    cfg = ContactSensorCfg(name="touch", primary=geom("nothing", "pile"))
    with pytest.raises(ValueError, match="'box_2'] and 197 others") as caught:
        Scene(SceneCfg(entities={"pile": many}, sensors=(cfg,)), "cpu")
    assert len(str(caught.value)) < 400
