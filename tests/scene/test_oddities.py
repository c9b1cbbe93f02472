"""Statements of an entity's file that a scene cannot follow: each is one warning, or it is right."""

from __future__ import annotations

import logging
import re
import warnings

import mujoco
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

PLANE = TerrainEntityCfg(terrain_type="plane")
FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'
BALL = '<body name="ball" pos="0 0 1"><freejoint/><geom name="hull" size=".1"/></body>'
LINK = (
    '<body name="link" pos="0 0 1"><joint name="slide" type="slide" axis="0 0 1"/>'
    '<geom name="bob" size=".1"/></body>'
)
HIGH = EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 1.0))


def thing(world: str, rest: str = "", **fields) -> EntityCfg:
    xml = f'<mujoco model="thing">{rest}<worldbody>{world}</worldbody></mujoco>'
    return EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(xml), **fields)


def build(*entities: EntityCfg, num_envs: int = 3, terrain=PLANE, **fields):
    """Return the simulation, the scene and the warnings of building them."""
    named = {f"thing_{k}": cfg for k, cfg in enumerate(entities)}
    cfg = SceneCfg(num_envs=num_envs, terrain=terrain, entities=named, env_spacing=3.0, **fields)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = Scene(cfg, device="cpu")
        sim = Simulation(num_envs, SimulationCfg(), spec=scene.spec, device="cpu")
        scene.initialize(sim.mj_model, sim.model, sim.data)
    return sim, scene, [str(one.message) for one in caught if one.category is UserWarning]


# The world of a file.

TO_WORLD = {
    "connect": '<equality><connect body1="{body}" anchor="0 0 0"/></equality>',
    "weld": '<equality><weld body1="{body}"/></equality>',
    "weld to a named world": '<equality><weld body1="{body}" body2="world"/></equality>',
    "sites": '<equality><connect site1="tip" site2="hook"/></equality>',
}


def with_sites(body: str) -> str:
    return body.replace("</body>", '<site name="tip"/></body>') + '<site name="hook" pos="0 0 1"/>'


@pytest.mark.parametrize("kind", TO_WORLD)
def test_fixed_bases_hold_equalities_everywhere(kind):
    world = with_sites(LINK) if kind == "sites" else LINK
    cfg = thing(world, TO_WORLD[kind].format(body="link"))
    sim, scene, said = build(cfg)
    assert not said
    pose = scene["thing_0"].data.default_root_state.clone()
    pose[:, :3] += scene.env_origins
    scene["thing_0"].write_mocap_pose_to_sim(pose)
    sim.step(100)
    assert scene.env_origins[:, 0].tolist() == [3.0, 0.0, -3.0]
    torch.testing.assert_close(
        scene["thing_0"].data.joint_pos, torch.zeros(3, 1), atol=1e-2, rtol=0.0
    )


@pytest.mark.parametrize("kind", TO_WORLD)
def test_floating_bases_tied_to_the_world_warn_once(kind):
    world = with_sites(BALL) if kind == "sites" else BALL
    cfg = thing(world, TO_WORLD[kind].format(body="ball"), init_state=HIGH)
    _, _, said = build(cfg)
    assert len(said) == 1
    assert re.search("'thing_0'.*" + ("'hook'" if kind == "sites" else "of body 'ball'"), said[0])
    assert not build(cfg, num_envs=1)[2]
    assert not build(cfg, terrain=None)[2]


def test_references_with_the_world_first_are_named():
    sensor = '<sensor><subtreecom name="all" body="world"/></sensor>'
    sensor += '<actuator><adhesion name="glue" body="world" ctrlrange="0 1"/></actuator>'
    weld = '<equality><weld name="glue" body1="world" body2="{}"/></equality>'
    _, scene, said = build(thing(BALL, weld.format("ball") + sensor, init_state=HIGH))
    assert len(said) == 1
    assert re.search("'thing_0'.*equality 'glue'.*sensor 'all'.*actuator 'glue'", said[0])
    sim, _, said = build(thing(LINK, weld.format("link") + sensor))
    assert not said
    assert (sim.mj_model.neq, sim.mj_model.nsensor, sim.mj_model.nu) == (1, 1, 1)


@pytest.mark.parametrize(
    ("world", "named"),
    [
        ('<geom name="step" size=".5"/>', "geoms ['step']"),
        ('<body name="block"><geom size=".1"/></body>', "bodies ['block']"),
        ('<body name="target" mocap="true"/>', "bodies ['target']"),
        ('<site name="goal"/>', "sites ['goal']"),
        ('<geom name="ramp" type="plane" size="1 1 1" euler="0 20 0"/>', "geoms ['ramp']"),
    ],
)
def test_static_elements_of_floating_bases_warn_once(world, named):
    for order in (world + BALL, BALL + world):
        _, _, said = build(thing(order, init_state=HIGH))
        assert len([text for text in said if named in text]) == len(said) == 1
    if "mocap" not in world:
        assert not build(thing(world + LINK))[2]


@pytest.mark.parametrize("engine", ["native", "warp"])
def test_links_touch_the_world_of_their_file(engine):
    """A link falls on a geom of the world, 0.4 m high, in each environment."""
    cfg = thing('<geom name="table" size=".2" pos="0 0 .2"/>' + LINK)
    scene = Scene(SceneCfg(num_envs=2, terrain=PLANE, entities={"thing": cfg}), "cpu")
    sim = Simulation(2, SimulationCfg(engine=engine), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    pose = scene["thing"].data.default_root_state.clone()
    pose[:, :3] += scene.env_origins
    scene["thing"].write_mocap_pose_to_sim(pose)
    sim.step(600)
    torch.testing.assert_close(
        scene["thing"].data.joint_pos, torch.full((2, 1), -0.5), atol=5e-3, rtol=0.0
    )


def contacts(model: mujoco.MjModel, prefix: str) -> set[tuple[str, ...]]:
    """Return the pairs of geoms that touch in the initial state."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {
        tuple(sorted(model.geom(int(geom)).name.removeprefix(prefix) for geom in contact.geom))
        for contact in data.contact[: data.ncon]
    }


@pytest.mark.parametrize(
    "rest",
    [
        "",
        '<contact><exclude body1="world" body2="leg"/></contact>',
        '<contact><exclude body1="link" body2="world"/></contact>',
        '<contact><exclude body1="base" body2="link"/></contact>',
        '<contact><pair geom1="table" geom2="foot"/></contact>',
        '<option><flag filterparent="disable"/></option>',
    ],
)
def test_contacts_are_those_of_the_file(rest):
    world = """<geom name="table" size=".3" pos="0 0 1"/>
      <body name="base" pos="0 0 1"><geom name="foot" size=".1" contype="2" conaffinity="3"/>
        <body name="link"><joint axis="0 1 0"/><geom name="shin" size=".2" conaffinity="2"/>
          <body name="leg"><joint axis="0 1 0"/><geom name="toe" size=".2" conaffinity="0"/></body>
        </body></body>"""
    alone = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{world}</worldbody>{rest}</mujoco>")
    sim, _, _ = build(thing(world, rest), num_envs=1, terrain=None)
    assert contacts(sim.mj_model, "thing_0/") == contacts(alone, "")


def test_only_bases_with_links_count_as_world():
    """Rays are slower with geoms of a mocap body that count as world."""
    table = '<body name="table"><geom size=".1"/></body>'
    model = build(thing(table), thing(LINK), thing(table + LINK))[0].mj_model
    is_world = [model.body(f"thing_{k}/mocap_base").weldid.item() == 0 for k in range(3)]
    assert is_world == [False, True, True]
    assert model.body("thing_2/table").weldid.item() == 0


# Grounds and initial states.


def test_a_second_ground_warns_once():
    floor = thing(FLOOR + BALL, init_state=HIGH)
    for cfgs, terrain in (((floor,), PLANE), ((floor, floor), None)):
        _, _, said = build(*cfgs, terrain=terrain)
        assert len(said) == 1
        assert re.search("2 grounds.*'floor' of entity 'thing_0'", said[0])
    assert not build(floor, terrain=None)[2]


def test_a_robot_that_starts_in_the_ground_warns_with_the_depth():
    leg = BALL.replace(
        "</body>", '<body><joint name="hip"/><geom size=".05" pos="0 0 -.3"/></body></body>'
    )
    key = '<keyframe><key name="home" qpos="0 0 .35 1 0 0 0 0"/></keyframe>'
    for joint_pos in ({}, None):
        init = EntityCfg.InitialStateCfg(joint_pos=joint_pos)
        _, _, said = build(thing(leg, key, init_state=init))
        assert len(said) == 1
        assert re.search("'thing_0'.*0.350 m.*'home'.*0.35", said[0])
    init = EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 0.35))
    assert not build(thing(leg, key, init_state=init))[2]


@pytest.mark.parametrize("links", ["", LINK.replace("0 0 1", "5 0 1", 1)])
def test_a_start_in_a_fixed_base_does_not_warn(links):
    wall = thing('<geom size=".2" pos="0 0 1"/>' + links)
    assert not build(wall, thing(BALL, init_state=HIGH))[2]


# Settings.


@pytest.mark.parametrize("body", [BALL, LINK])
@pytest.mark.parametrize(
    ("block", "field", "assigned"),
    [
        (
            '<visual><map znear="0.05"/></visual>',
            "visual.map.znear",
            "spec.visual.map.znear = 0.05",
        ),
        ('<size njmax="500"/>', "njmax", "sim.njmax = 500"),
        ('<size nuserdata="5"/>', "nuserdata", "spec.nuserdata = 5"),
        ('<size memory="1M"/>', "memory", "spec.memory = 1048576"),
    ],
)
def test_a_conflict_names_field_value_and_remedy(body, block, field, assigned, caplog):
    cfg = thing(body, block, init_state=HIGH)
    _, _, said = build(cfg)
    assert len(said) == 1
    assert re.search(f"'thing_0'.*{field} is.*{re.escape(assigned)}", said[0])
    assert not caplog.records


def test_a_setting_of_the_scene_is_no_conflict():
    def follow(spec: mujoco.MjSpec) -> None:
        spec.visual.map.znear = 0.05

    cfg = thing(BALL, '<visual><map znear="0.05"/></visual>', init_state=HIGH)
    assert not build(cfg, spec_fn=follow)[2]
    user = thing(BALL.replace("size", 'user="1 2" size'), '<size nuser_geom="2"/>', init_state=HIGH)
    sim, _, said = build(user)
    assert not said
    assert sim.mj_model.geom("thing_0/hull").user.tolist() == [1.0, 2.0]


def test_looks_of_an_entity_are_logged(caplog):
    looks = '<statistic extent="2"/><visual><headlight ambient=".4 .4 .4"/></visual>'
    with caplog.at_level(logging.INFO):
        assert not build(thing(BALL, looks, init_state=HIGH))[2]
    assert "visual.headlight.ambient = (0.4, 0.4, 0.4)" in caplog.text
    assert "stat.extent = 2" in caplog.text


# Initial joint positions.

ARM = (
    '<body name="arm" pos="0 0 1"><joint name="slider" type="slide" range="-1 1"/><geom size=".1"/>'
    '<body name="pole"><joint name="hinge_1" range="{range}"/><geom size=".1"/>'
    '<body name="tip"><joint name="hinge_2"/><geom size=".1"/></body></body></body>'
)
RADIAN = '<compiler angle="radian"/>'


def arm(joint_pos=None, joint_vel=None, limits="-1 1", rest=RADIAN, **fields):
    fields |= {} if joint_pos is None else {"joint_pos": joint_pos}
    fields |= {} if joint_vel is None else {"joint_vel": joint_vel}
    state = EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 1.0), **fields)
    return thing(ARM.format(range=limits), rest, init_state=state)


@pytest.mark.parametrize("field", ["joint_pos", "joint_vel"])
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"hinge": 0.5}, (0.0, 0.5, 0.5)),
        ({"hinge": 0.5, ".*": 0.2}, (0.2, 0.5, 0.5)),
        ({".*": 0.2, "hinge": 0.5}, (0.2, 0.2, 0.2)),
        ({"hinge_1": 0.5}, (0.0, 0.5, 0.0)),
        ({}, (0.0, 0.0, 0.0)),
    ],
)
def test_patterns_match_from_the_start(field, values, expected):
    _, scene, messages = build(arm(**{field: values}))
    assert getattr(scene["thing_0"].data, f"default_{field}")[1].tolist() == pytest.approx(expected)
    assert messages == []


@pytest.mark.parametrize("field", ["joint_pos", "joint_vel"])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_patterns_without_a_joint_warn_once(field, num_envs):
    typos = {"hing_1": 0.5, "_2": 0.1, "slider": 0.2}
    _, scene, messages = build(arm(**{field: typos}), num_envs=num_envs)
    (message,) = messages
    for words in ("'thing_0'", f"init_state.{field}", "['hing_1', '_2']", "did you mean 'hinge_1'"):
        assert words in message
    values = getattr(scene["thing_0"].data, f"default_{field}")[0].tolist()
    assert values == pytest.approx((0.2, 0.0, 0.0))


@pytest.mark.parametrize(
    ("cfg", "words"),
    [
        (arm({"slider": 3.0}), ("'slider' at 3 (limits -1 to 1)",)),
        (arm({"slider": -1.5, "hinge": 2.0}), ("'slider' at -1.5", "'hinge_1' at 2")),
        (arm({"hinge_1": 0.5}, rest=""), ("'hinge_1' at 0.5", 'angle="radian"')),
        (arm({"hinge_1": 45.0}), ("'hinge_1' at 45", "in rad, not in degrees")),
    ],
)
def test_initial_positions_beyond_limits_warn_once(cfg, words):
    (message,) = build(cfg)[2]
    for word in ("'thing_0'", "init_state.joint_pos", *words):
        assert word in message
    assert ("radian" in message) == any("radian" in word for word in words)


@pytest.mark.parametrize(
    "cfg",
    [
        arm({"slider": 1.0, "hinge_1": -1.0, "hinge_2": 100.0}),
        arm({"hinge_1": 1.5708}, limits="-1.5707 1.5707"),
        arm({"hinge_1": 0.5}, limits="-45 45", rest=""),
    ],
)
def test_initial_positions_at_limits_do_not_warn(cfg):
    assert build(cfg)[2] == []
