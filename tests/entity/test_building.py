"""Entity spec construction from the config."""

from __future__ import annotations

import logging
import zipfile

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import (
    BuiltinMotorActuatorCfg,
    BuiltinPdActuatorCfg,
    BuiltinPositionActuatorCfg,
    TransmissionType,
    XmlActuatorCfg,
)
from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg
from mjlab.utils.spec_config import CameraCfg, CollisionCfg

InitialState = EntityCfg.InitialStateCfg


def key_of(entity: Entity) -> tuple[list[float], list[float]]:
    model = entity.compile()
    return model.key("init_state").qpos.tolist(), model.key("init_state").ctrl.tolist()


def actuated(*actuators) -> EntityArticulationInfoCfg:
    return EntityArticulationInfoCfg(actuators=actuators)


# Bases and joints.


def test_a_fixed_base_is_put_under_a_mocap_body_at_its_initial_pose(kit):
    half = 0.5**0.5
    arm = kit.cfg(
        kit.ARM, init_state=InitialState(pos=(1.0, 2.0, 3.0), rot=(half, 0.0, 0.0, half))
    ).build()
    assert (arm.is_fixed_base, arm.is_mocap, arm.is_articulated) == (True, True, True)
    assert arm.body_names == ("mocap_base", "link1", "link2")
    assert arm.joint_names == arm.all_joint_names == ("shoulder", "elbow")
    model = arm.compile()
    assert model.body("mocap_base").pos.tolist() == [1.0, 2.0, 3.0]
    assert model.body("mocap_base").quat.tolist() == pytest.approx([half, 0.0, 0.0, half])
    assert model.body("link1").pos.tolist() == [0.0, 0.0, 0.3], "the authored offset is gone"


def test_an_authored_mocap_root_takes_the_initial_orientation(kit):
    xml = '<mujoco><worldbody><body name="m" mocap="true" euler="0 0 90"/></worldbody></mujoco>'
    entity = kit.cfg(xml, init_state=InitialState(rot=(0.0, 1.0, 0.0, 0.0))).build()
    assert entity.body_names == ("m",)
    assert entity.compile().body("m").quat.tolist() == [0.0, 1.0, 0.0, 0.0]


def test_the_default_spec_is_a_lone_mocap_body():
    entity = EntityCfg().build()
    assert entity.body_names == ("mocap_base",)
    assert (entity.is_articulated, entity.is_actuated) == (False, False)


def test_an_unnamed_free_joint_is_named(kit):
    robot = kit.cfg(kit.ROBOT).build()
    assert (robot.is_fixed_base, robot.is_mocap) == (False, False)
    assert robot.all_joint_names == ("floating_base_joint", "hip", "knee")
    assert robot.joint_names == ("hip", "knee")
    assert robot.num_joints == 2


def test_two_free_joints_are_refused(kit):
    xml = """<mujoco model="pair"><worldbody>
      <body name="a"><freejoint/><geom size=".1"/></body>
      <body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    with pytest.raises(ValueError, match=r"'pair'.*free joint.* 2, .*\['a', 'b'\]"):
        kit.cfg(xml).build()


SERVO = BuiltinPositionActuatorCfg(target_names_expr=("hip", "knee"), stiffness=1.0, damping=1.0)
MOTOR = BuiltinMotorActuatorCfg(target_names_expr=("k.*",), effort_limit=1.0)
IN_XML = '<actuator><motor name="drive" joint="knee"/></actuator></mujoco>'


@pytest.mark.parametrize("sort", [False, True])
@pytest.mark.parametrize("actuators", [(SERVO, MOTOR), (MOTOR, SERVO), (SERVO, SERVO)])
def test_two_configs_for_a_joint_raise(kit, actuators, sort):
    cfg = kit.cfg(kit.ROBOT, sort_actuators=sort, articulation=actuated(*actuators))
    with pytest.raises(ValueError, match="repeated name '(hip|knee)' in actuator"):
        cfg.build()


def test_an_xml_actuator_may_be_taken_over_twice(kit):
    wrap = XmlActuatorCfg(target_names_expr=("knee",), command_field="effort")
    xml = kit.ROBOT.replace("</mujoco>", IN_XML)
    with pytest.warns(UserWarning, match=r"XmlActuatorCfg.*\['knee'\]"):
        sim, scene = kit.make(1, robot=kit.cfg(xml, articulation=actuated(wrap, wrap)))
    scene["robot"].set_joint_effort_target(torch.tensor([[0.0, 3.0]]))
    scene.write_data_to_sim()
    assert sim.data.ctrl.tolist() == [[3.0]]


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("sort", [False, True])
def test_actuators_beside_the_xml_warn_and_act(kit, wrapped, sort):
    actuators = [SERVO, *([XmlActuatorCfg(target_names_expr=("knee",))] if wrapped else [])]
    cfg = kit.cfg(
        kit.ROBOT.replace("</mujoco>", IN_XML),
        sort_actuators=sort,
        articulation=actuated(*actuators),
    )
    with pytest.warns(UserWarning, match=r"\['knee'\].*forces add up"):
        sim, scene = kit.make(1, robot=cfg)
    robot = scene["robot"]
    robot.set_joint_position_target(torch.tensor([[0.0, 0.5]]))
    robot.set_joint_effort_target(torch.tensor([[0.0, 2.0]]))
    robot.write_joint_state_to_sim(torch.zeros(1, 2), torch.zeros(1, 2))
    if not wrapped:
        sim.data.ctrl[:, robot.actuator_names.index("drive")] = 2.0
    scene.write_data_to_sim()
    sim.forward()
    # The servo's share is its stiffness of 1 times the distance.
    assert sim.data.qfrc_actuator[0, -1].item() == pytest.approx(0.5 + 2.0)


def test_actuators_of_the_xml_and_others_may_share_a_pattern_but_no_joint(kit):
    """The one that wraps those of the XML leaves out joints that have none, whatever the order."""
    motor = BuiltinMotorActuatorCfg(target_names_expr=("hip",), effort_limit=1.0)
    wrapped = XmlActuatorCfg(target_names_expr=("hip", "knee"))
    for actuators in ((motor, wrapped), (wrapped, motor)):
        xml = kit.ROBOT.replace("</mujoco>", IN_XML)
        robot = kit.cfg(xml, articulation=actuated(*actuators)).build()
        by_config = {type(a.cfg): a.target_names for a in robot.actuators}
        assert by_config == {BuiltinMotorActuatorCfg: ["hip"], XmlActuatorCfg: ["knee"]}


DOOR_AND_BALL = """<mujoco><worldbody>
  <body name="door"><joint name="hinge" type="slide"/><geom size=".1"/></body>
  <body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/>
    <body name="fin"><joint name="flap" axis="0 1 0"/><geom size=".02" pos=".2 0 0"/></body>
  </body></worldbody></mujoco>"""


def test_root_is_the_body_of_the_free_joint(kit):
    init = InitialState(pos=(1.0, 2.0, 3.0), joint_pos={"hinge": 0.5, "flap": -0.5})
    sim, scene = kit.make(2, thing=kit.cfg(DOOR_AND_BALL, init_state=init))
    thing, data = scene["thing"], scene["thing"].data
    assert not thing.is_fixed_base
    assert thing.root_body.name == "thing/ball"
    assert thing.body_names == ("door", "ball", "fin")
    assert thing.joint_names == ("hinge", "flap")
    np.testing.assert_allclose(sim.mj_model.key("init_state").qpos[:4], [0.5, 1.0, 2.0, 3.0])
    state = data.default_root_state.clone()
    state[1, 7:] = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    thing.write_root_state_to_sim(state)
    thing.write_joint_position_to_sim(data.default_joint_pos)
    sim.forward()
    torch.testing.assert_close(data.root_link_pos_w[1], torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(data.root_link_vel_w[1], state[1, 7:])
    torch.testing.assert_close(data.root_com_lin_vel_w, data.body_com_lin_vel_w[:, 1])
    assert data.joint_pos[0].tolist() == [0.5, -0.5]


def test_a_block_before_the_robot_is_not_its_root(kit):
    xml = """<mujoco><worldbody>
      <body name="block" pos="2 0 .5"><geom size=".1"/></body>
      <body name="robot" pos="0 0 1"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
    sim, scene = kit.make(1, robot=kit.cfg(xml))
    sim.data.qvel[0, :3] = torch.tensor([0.0, 0.0, -3.0])
    sim.forward()
    data = scene["robot"].data
    assert data.root_link_pos_w[0].tolist() == [0.0, 0.0, 1.0]
    assert data.root_link_lin_vel_b[0].tolist() == [0.0, 0.0, -3.0]
    assert data.heading_w.shape == (1,)


def test_ball_joints_are_passive(kit):
    xml = """<mujoco><worldbody><body name="arm"><joint name="socket" type="ball"/>
      <geom size=".1" pos=".2 0 0"/>
      <body><joint name="hinge" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/></body>
      </body></worldbody></mujoco>"""
    cfg = kit.cfg(xml, init_state=InitialState(joint_pos={"hinge": 0.5}))
    with pytest.warns(UserWarning, match=r"ball joints \['socket'\]"):
        sim, scene = kit.make(2, arm=cfg)
    arm = scene["arm"]
    assert arm.joint_names == ("hinge",)
    assert arm.all_joint_names == ("socket", "hinge")
    np.testing.assert_allclose(sim.mj_model.key("init_state").qpos, [1, 0, 0, 0, 0.5])
    arm.write_joint_position_to_sim(arm.data.default_joint_pos)
    assert sim.data.qpos[1].tolist() == [1.0, 0.0, 0.0, 0.0, 0.5]
    assert arm.data.joint_vel.shape == (2, 1)


def test_dropped_elements_are_named(kit):
    def spec_fn():
        spec = mujoco.MjSpec.from_string(kit.ROBOT)
        spec.add_actuator(name="motor", target="hip")
        spec.add_exclude(name="pair", bodyname1="base", bodyname2="nobody")
        return spec

    motor = BuiltinMotorActuatorCfg(target_names_expr=("knee",), effort_limit=1.0)
    with pytest.warns(UserWarning, match=r"actuators \['motor'\], excludes \['pair'\].*trntype"):
        _, scene = kit.make(1, robot=EntityCfg(spec_fn=spec_fn, articulation=actuated(motor)))
    assert scene["robot"].actuator_names == ("knee",)


def test_joints_without_a_name_work(kit):
    """The reference raises KeyError when it initializes them."""
    xml = """<mujoco><worldbody><body><joint/><geom size=".1"/>
      <body><joint name="b"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    init = InitialState(joint_pos={".*": 0.5})
    sim, scene = kit.make(2, other=kit.cfg(kit.ARM), chain=kit.cfg(xml, init_state=init))
    chain = scene["chain"]
    assert chain.joint_names == ("", "b")
    chain.write_joint_position_to_sim(torch.tensor([[1.0, 2.0]]).repeat(2, 1))
    assert sim.data.qpos[0].tolist() == [0.0, 0.0, 1.0, 2.0]


def test_a_spec_fn_that_returns_no_spec_is_reported():
    with pytest.raises(ValueError, match="EntityCfg.spec_fn.*mujoco.MjSpec, got str"):
        EntityCfg(spec_fn=lambda: "robot.xml").build()


# Initial state.


def test_the_keyframe_holds_pose_joints_and_position_controls_only(kit):
    """The reference also writes joint positions into the controls of motors."""
    init = InitialState(
        pos=(0.0, 0.0, 2.0), rot=(0.0, 1.0, 0.0, 0.0), joint_pos={"hip": 0.3, "kn": -0.4}
    )
    robot = kit.cfg(
        kit.ROBOT,
        init_state=init,
        articulation=actuated(
            BuiltinMotorActuatorCfg(target_names_expr=("hip",), effort_limit=1.0),
            BuiltinPositionActuatorCfg(target_names_expr=("knee",), stiffness=1.0, damping=0.1),
        ),
    ).build()
    qpos, ctrl = key_of(robot)
    assert qpos == [0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.3, -0.4]
    assert ctrl == [0.0, -0.4]


def test_the_first_pattern_wins_and_other_joints_are_zero(kit):
    init = InitialState(joint_pos={"h": 0.1, ".*": 0.2}, joint_vel={"knee": 5.0})
    _, scene = kit.make(2, robot=kit.cfg(kit.ROBOT, init_state=init))
    data = scene["robot"].data
    torch.testing.assert_close(data.default_joint_pos, torch.tensor([[0.1, 0.2]] * 2))
    assert data.default_joint_vel.tolist() == [[0.0, 5.0]] * 2


def test_default_root_state_is_that_of_the_config(kit):
    init = InitialState(
        pos=(1.0, 2.0, 3.0), rot=(0.0, 0.0, 1.0, 0.0), lin_vel=(4.0, 5.0, 6.0),
        ang_vel=(7.0, 8.0, 9.0),
    )  # fmt: skip
    _, scene = kit.make(
        2, robot=kit.cfg(kit.ROBOT, init_state=init), arm=kit.cfg(kit.ARM, init_state=init)
    )
    pose = [1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0]
    expected = [*pose, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    assert scene["robot"].data.default_root_state.tolist() == [expected] * 2
    assert scene["arm"].data.default_root_state.tolist() == [pose] * 2


def test_entities_without_joints_are_silent(caplog):
    with caplog.at_level(logging.WARNING):
        EntityCfg().build()
    assert not caplog.records


def test_a_vector_of_the_wrong_length_is_reported(kit):
    with pytest.raises(ValueError, match="init_state.rot: expected 4 values"):
        kit.cfg(kit.ARM, init_state=InitialState(rot=(0.0, 0.0, 0.0))).build()


WITH_KEY = """<mujoco model="keyed"><worldbody>
  <body name="b"><freejoint/><geom size=".1"/>
    <body><joint name="a"/><geom size=".1"/><body><joint name="c"/><geom size=".1"/></body></body>
  </body></worldbody>
  <actuator><motor joint="a"/><position joint="c" kp="3"/></actuator>
  <keyframe><key name="home" qpos="9 9 9 0 1 0 0 .7 -.7" ctrl=".1 .2"/></keyframe></mujoco>"""


def test_joint_pos_none_takes_this_entitys_part_of_the_keyframe(kit):
    """The reference takes the rest of the whole scene's qpos, in float64."""
    init = InitialState(joint_pos=None, pos=(1.0, 0.0, 0.0))
    _, scene = kit.make(
        2,
        arm=kit.cfg(kit.ARM),
        keyed=kit.cfg(WITH_KEY, init_state=init),
        robot=kit.cfg(kit.ROBOT),
    )
    data = scene["keyed"].data
    torch.testing.assert_close(data.default_joint_pos, torch.tensor([[0.7, -0.7]] * 2))
    assert data.default_root_state[0, :3].tolist() == [1.0, 0.0, 0.0]


def test_joint_pos_none_takes_the_controls_of_the_keyframe(kit):
    qpos, ctrl = key_of(kit.cfg(WITH_KEY, init_state=InitialState(joint_pos=None)).build())
    assert qpos == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.7, -0.7]
    assert ctrl == [0.1, 0.2]


def test_the_configured_initial_state_wins_over_the_keyframe_of_the_xml(kit):
    entity = kit.cfg(WITH_KEY, init_state=InitialState(joint_pos={".*": 0.25})).build()
    qpos, ctrl = key_of(entity)
    assert qpos[7:] == [0.25, 0.25]
    assert ctrl == [0.0, 0.25]
    assert [key.name for key in entity.spec.keys] == ["init_state"]


def test_several_keyframes_are_reported(kit):
    xml = WITH_KEY.replace("<keyframe>", '<keyframe><key name="start"/>')
    with pytest.warns(UserWarning, match=r"2 keyframes: \['start', 'home'\]"):
        kit.cfg(xml).build()


def test_joint_pos_none_without_a_keyframe_says_what_to_do(kit):
    with pytest.raises(ValueError, match="'arm' has no keyframe.*joint_pos to a dict"):
        kit.cfg(kit.ARM, init_state=InitialState(joint_pos=None)).build()


def test_joint_pos_none_with_a_keyframe_that_does_not_fit(kit):
    xml = WITH_KEY.replace("9 9 9 0 1 0 0 .7 -.7", "1 2 3")
    with pytest.raises(ValueError, match="9 values in qpos.*'home' with 3"):
        kit.cfg(xml, init_state=InitialState(joint_pos=None)).build()


# Actuators.


def test_an_actuator_pattern_that_matches_nothing_lists_the_candidates(kit):
    cfg = BuiltinMotorActuatorCfg(target_names_expr=("hip", "ankle"), effort_limit=1.0)
    with pytest.raises(ValueError) as caught:
        kit.cfg(kit.ROBOT, articulation=actuated(cfg)).build()
    text = str(caught.value)
    assert "match no name: ['ankle']" in text, "the real cause is one pattern of the two"
    assert "Available names: ['hip', 'knee']" in text


def test_an_actuator_pattern_that_matches_elsewhere_says_where(kit):
    cfg = BuiltinMotorActuatorCfg(target_names_expr=("cable",), effort_limit=1.0)
    with pytest.raises(ValueError, match=r"tendons \['cable'\].*TransmissionType.TENDON"):
        kit.cfg(kit.ARM, articulation=actuated(cfg)).build()


def test_a_name_matched_twice_is_reported_as_such(kit):
    """The reference says that nothing matched."""
    cfg = BuiltinMotorActuatorCfg(target_names_expr=("hip", "h.*"), effort_limit=1.0)
    with pytest.raises(ValueError, match="'hip' is matched by several patterns"):
        kit.cfg(kit.ROBOT, articulation=actuated(cfg)).build()


def test_patterns_that_also_match_another_namespace_warn(kit):
    xml = kit.ARM.replace('name="cable"', 'name="elbow"')
    cfg = BuiltinMotorActuatorCfg(target_names_expr=("elbow",), effort_limit=1.0)
    with pytest.warns(UserWarning, match=r"also match the tendons \['elbow'\]"):
        kit.cfg(xml, articulation=actuated(cfg)).build()


def test_an_unnamed_target_is_refused_by_name(kit):
    xml = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    cfg = BuiltinMotorActuatorCfg(target_names_expr=(".*",), effort_limit=1.0)
    with pytest.raises(ValueError, match="unnamed joint"):
        kit.cfg(xml, articulation=actuated(cfg)).build()


def test_actuators_come_config_by_config_in_spec_order(kit):
    robot = kit.cfg(
        kit.ROBOT,
        articulation=actuated(
            BuiltinMotorActuatorCfg(
                target_names_expr=("foot",), transmission_type=TransmissionType.SITE,
                effort_limit=1.0,
            ),
            BuiltinMotorActuatorCfg(target_names_expr=("knee", "hip"), effort_limit=1.0),
        ),
    ).build()  # fmt: skip
    assert robot.actuator_names == ("foot", "hip", "knee")
    assert (robot.has_site_actuators, robot.has_tendon_actuators) == (True, False)


def test_sorted_actuators_follow_their_targets_after_those_of_the_xml(kit):
    xml = kit.ROBOT.replace(
        "</mujoco>", '<actuator><motor name="knee_xml" joint="knee"/></actuator></mujoco>'
    )
    robot = kit.cfg(
        xml,
        sort_actuators=True,
        articulation=actuated(
            BuiltinMotorActuatorCfg(
                target_names_expr=("foot",), transmission_type=TransmissionType.SITE,
                effort_limit=1.0,
            ),
            XmlActuatorCfg(target_names_expr=("knee",)),
            BuiltinMotorActuatorCfg(target_names_expr=("hip",), effort_limit=1.0),
        ),
    ).build()  # fmt: skip
    assert robot.actuator_names == ("knee_xml", "hip", "foot")


def test_sorted_native_pd_writes_the_right_controls(kit):
    """The reference assumes all positions before all velocities, which sorting breaks."""
    pd = BuiltinPdActuatorCfg(target_names_expr=("hip", "knee"), stiffness=1.0, damping=1.0)
    sim, scene = kit.make(
        2, robot=kit.cfg(kit.ROBOT, sort_actuators=True, articulation=actuated(pd))
    )
    robot = scene["robot"]
    robot.set_joint_position_target(torch.tensor([[0.1, 0.2]]).repeat(2, 1))
    robot.set_joint_velocity_target(torch.tensor([[0.3, 0.4]]).repeat(2, 1))
    scene.write_data_to_sim()
    named = dict(zip(robot.actuator_names, sim.data.ctrl[1].tolist(), strict=True))
    assert named == pytest.approx(
        {"hip_pd_pos": 0.1, "hip_pd_vel": 0.3, "knee_pd_pos": 0.2, "knee_pd_vel": 0.4}
    )


def test_actuators_of_an_entity_put_together_from_others(kit):
    """Such an entity reports short names; its spec knows full ones."""

    def spec_fn():
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="torso")
        body.add_freejoint()
        body.add_geom(size=[0.1, 0, 0])
        arm = mujoco.MjSpec.from_string(kit.ARM)
        spec.attach(arm, prefix="left/", frame=body.add_frame())
        return spec

    cfg = BuiltinMotorActuatorCfg(target_names_expr=("elbow",), effort_limit=1.0)
    entity = EntityCfg(spec_fn=spec_fn, articulation=actuated(cfg)).build()
    assert entity.joint_names == ("shoulder", "elbow")
    model = entity.compile()
    assert model.joint(model.actuator_trnid[0, 0]).name == "left/elbow"


def test_actuators_of_the_xml_that_no_config_lists_stay_at_zero(kit):
    xml = kit.ROBOT.replace(
        "</mujoco>",
        '<actuator><motor name="m1" joint="knee"/><motor name="m2" joint="hip"/></actuator></mujoco>',
    )
    cfg = actuated(XmlActuatorCfg(target_names_expr=("hip",)))
    sim, scene = kit.make(2, robot=kit.cfg(xml, articulation=cfg))
    robot = scene["robot"]
    assert robot.actuator_names == ("m1", "m2")
    assert robot.indexing.ctrl_ids.tolist() == [0, 1]
    robot.set_joint_effort_target(torch.full((2, 2), 3.0))
    scene.write_data_to_sim()
    assert sim.data.ctrl.tolist() == [[0.0, 3.0]] * 2


def test_an_entity_without_configured_actuators_has_no_controls(kit):
    xml = kit.ROBOT.replace("</mujoco>", '<actuator><motor joint="knee"/></actuator></mujoco>')
    _, scene = kit.make(2, robot=kit.cfg(xml))
    robot = scene["robot"]
    assert robot.num_actuators == 1
    assert not robot.is_actuated
    assert robot.indexing.actuators is None
    assert robot.indexing.ctrl_ids.tolist() == []


# Editors and files.


def test_editors_run_and_overlapping_ones_warn(kit):
    cfg = kit.cfg(
        kit.ROBOT,
        cameras=(CameraCfg(name="eye", body="shin"),),
        collisions=(
            CollisionCfg(
                geom_names_expr=("trunk",), contype=2, conaffinity=4, condim=4, priority=1
            ),
        ),
    )
    robot = cfg.build()
    model = robot.compile()
    assert robot.camera_names == ("eye",)
    assert model.geom("trunk").contype[0] == 2
    assert model.geom("thigh_geom").contype[0] == 0, "other geoms are disabled"


def test_write_xml_and_to_zip_can_be_read_again(kit, tmp_path):
    robot = kit.cfg(kit.ROBOT).build()
    robot.write_xml(tmp_path / "robot.xml")
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert again.nq == robot.compile().nq
    robot.to_zip(tmp_path / "robot.zip")
    assert any(name.endswith(".xml") for name in zipfile.ZipFile(tmp_path / "robot.zip").namelist())


def test_building_twice_from_one_config_gives_independent_entities(kit):
    cfg = kit.cfg(kit.ROBOT)
    first, second = cfg.build(), cfg.build()
    first.spec.body("thigh").add_site(name="mark")
    assert "mark" not in second.site_names


@pytest.mark.parametrize("xml", ["ROBOT", "ARM"])
def test_a_spec_fn_may_return_one_spec_for_two_entities_and_two_scenes(kit, xml):
    spec = mujoco.MjSpec.from_string(getattr(kit, xml))
    spec.option.density = 3.0
    spec.add_key(name="home", qpos=[0.1] * spec.compile().nq)
    written = spec.to_xml()
    cfg = EntityCfg(
        spec_fn=lambda: spec,
        cameras=(CameraCfg(name="eye", body=spec.bodies[-1].name),),
        articulation=actuated(
            BuiltinMotorActuatorCfg(target_names_expr=(spec.joints[-1].name,), effort_limit=5.0)
        ),
    )
    once = cfg.build().compile()
    for _ in range(2):
        _, scene = kit.make(2, one=cfg, two=cfg)
        model = scene.compile()
        assert (model.nq, model.nu, model.ncam) == (2 * once.nq, 2, 2)
        assert scene["two"].joint_names == scene["one"].joint_names
        assert model.opt.density == 3.0
    # The user's spec is unchanged.
    assert spec.to_xml() == written
