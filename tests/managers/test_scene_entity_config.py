"""Selections by name and by index."""

from __future__ import annotations

import copy
import pickle
import warnings

import mujoco
import pytest
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg, XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.managers import SceneEntityCfg
from mjlab.managers.scene_entity_config import columns_of

KINDS = (
    "joint",
    "body",
    "geom",
    "site",
    "actuator",
    "tendon",
    "camera",
    "light",
    "material",
    "texture",
    "pair",
)


@pytest.mark.parametrize("kind", KINDS)
def test_names_become_the_names_and_indices_they_match(env, kind):
    cfg = SceneEntityCfg("robot", **{f"{kind}_names": f"{kind}_[ac]"})
    cfg.resolve(env.scene)
    assert getattr(cfg, f"{kind}_ids") == [0, 2]
    assert list(getattr(cfg, f"{kind}_names")) == [f"{kind}_a", f"{kind}_c"]


@pytest.mark.parametrize("kind", KINDS)
def test_indices_become_names(env, kind):
    cfg = SceneEntityCfg("robot", **{f"{kind}_ids": [2, 0]})
    cfg.resolve(env.scene)
    assert list(getattr(cfg, f"{kind}_names")) == [f"{kind}_c", f"{kind}_a"]
    assert getattr(cfg, f"{kind}_ids") == [2, 0]


def test_all_in_natural_order_stay_a_slice(env):
    cfg = SceneEntityCfg("robot", joint_names=("joint_c", "joint_.*[ab]"))
    cfg.resolve(env.scene)
    assert cfg.joint_ids == slice(None)
    assert list(cfg.joint_names) == ["joint_a", "joint_b", "joint_c"]


def test_all_in_another_order_are_a_list(env):
    cfg = SceneEntityCfg("robot", joint_names=("joint_c", "joint_.*[ab]"), preserve_order=True)
    cfg.resolve(env.scene)
    assert cfg.joint_ids == [2, 0, 1]
    assert list(cfg.joint_names) == ["joint_c", "joint_a", "joint_b"]


def test_nothing_given_stays_untouched(env):
    cfg = SceneEntityCfg("robot", body_ids=slice(1, 2))
    cfg.resolve(env.scene)
    assert cfg.joint_names is None
    assert cfg.joint_ids == slice(None)
    assert cfg.body_names is None
    assert cfg.body_ids == slice(1, 2)


def test_an_empty_tuple_selects_nothing(env):
    cfg = SceneEntityCfg("robot", joint_names=())
    cfg.resolve(env.scene)
    assert cfg.joint_ids == []


@pytest.mark.parametrize(
    "fields",
    [
        {"joint_names": ("joint_[ab]",)},
        {"joint_names": ".*"},
        {"joint_names": ("joint_c", "joint_a"), "preserve_order": True},
        {"joint_ids": [2, 1]},
        {"joint_names": ()},
    ],
)
def test_resolving_twice_changes_nothing(env, fields):
    cfg = SceneEntityCfg("robot", **fields)
    # Indices out of natural order only agree with names whose order is kept.
    cfg.preserve_order = True
    cfg.resolve(env.scene)
    once = copy.deepcopy(cfg)
    cfg.resolve(env.scene)
    assert cfg == once


def test_names_with_characters_of_patterns_find_themselves_again(env):
    env.scene["robot"].geom_names = ("foot[1]", "foot[2]", "leg")
    cfg = SceneEntityCfg("robot", geom_names="foot.*")
    cfg.resolve(env.scene)
    cfg.resolve(env.scene)
    assert cfg.geom_ids == [0, 1]
    assert list(cfg.geom_names) == ["foot[1]", "foot[2]"]


def test_names_and_indices_that_agree_are_kept(env):
    cfg = SceneEntityCfg("robot", joint_names=("joint_b",), joint_ids=[1])
    cfg.resolve(env.scene)
    assert cfg.joint_ids == [1]


@pytest.mark.parametrize("names", [("joint_a",), ("joint_[b]",)])
def test_names_and_indices_that_differ_are_refused(env, names):
    cfg = SceneEntityCfg("robot", joint_names=names, joint_ids=[1])
    with pytest.raises(ValueError, match="joint_names=.*joint_ids=.*disagree"):
        cfg.resolve(env.scene)


def test_a_pattern_that_matches_nothing_lists_the_names(env):
    cfg = SceneEntityCfg("robot", joint_names=("knee",))
    with pytest.raises(ValueError, match=r"'robot'(.|\n)*knee(.|\n)*joint_a"):
        cfg.resolve(env.scene)


def test_an_index_out_of_range_is_refused(env):
    with pytest.raises(ValueError, match=r"joint_ids: .*got \[3\]"):
        SceneEntityCfg("robot", joint_ids=[0, 3]).resolve(env.scene)


def test_an_unknown_entity_lists_what_there_is(env):
    with pytest.raises(KeyError, match="robot"):
        SceneEntityCfg("dog").resolve(env.scene)


def test_a_sensor_can_be_named_but_not_selected_from(env):
    SceneEntityCfg("camera").resolve(env.scene)
    with pytest.raises(ValueError, match="'camera': .*joint, got SimpleNamespace"):
        SceneEntityCfg("camera", joint_names="a").resolve(env.scene)


def test_names_and_indices_in_another_order_agree(env):
    cfg = SceneEntityCfg("robot", joint_names=("joint_c", "joint_a"), joint_ids=[2, 0])
    cfg.resolve(env.scene)
    assert cfg.joint_ids == [2, 0]


@pytest.mark.parametrize("names", ["", ".*", ("",), ("leg", "")])
def test_repeated_names_resolve_to_the_same_ids(env, names):
    env.scene["robot"].geom_names = ("", "leg", "")
    cfg = SceneEntityCfg("robot", geom_names=names)
    cfg.resolve(env.scene)
    once = copy.deepcopy(cfg)
    for one in (cfg, copy.deepcopy(cfg), pickle.loads(pickle.dumps(cfg))):
        one.resolve(env.scene)
        assert one == once
    assert once.geom_ids == ([0, 2] if set(names) <= {""} else slice(None))


def test_a_failed_selection_is_unchanged(env):
    cfg = SceneEntityCfg("robot", joint_names="joint_a", body_names="arm")
    with pytest.raises(ValueError, match="arm"):
        cfg.resolve(env.scene)
    assert cfg == SceneEntityCfg("robot", joint_names="joint_a", body_names="arm")


# Kinds that follow from others.

LEGS = """
<mujoco>
  <worldbody>
    <body name="trunk">
      {joint}
      <geom size=".1"/>
      <site name="imu"/>
      <body name="leg">
        <joint name="hip"/>
        <geom size=".1" name="thigh"/>
        <geom size=".2"/>
        <body name="shin">
          <joint name="knee"/>
          <joint name="ankle"/>
          <geom size=".1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="cable"><joint joint="hip" coef="1"/></fixed></tendon>
  <actuator>
    <motor name="pull" tendon="cable"/>
    <motor name="bend" joint="knee"/>
    <motor name="turn" joint="hip"/>
  </actuator>
</mujoco>
"""


def legs(joint="<freejoint/>", actuators=None):
    actuators = actuators or (
        XmlActuatorCfg(target_names_expr=("knee", "hip")),
        BuiltinPositionActuatorCfg(target_names_expr=("knee",), stiffness=1.0, damping=1.0),
    )
    cfg = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(LEGS.format(joint=joint)),
        articulation=EntityArticulationInfoCfg(actuators=actuators),
    )
    return {"robot": cfg.build()}


def resolved(scene, **fields):
    cfg = SceneEntityCfg("robot", **fields)
    cfg.resolve(scene)
    return cfg


# Actuators: pull (a tendon), bend and the servo called knee (knee), turn (hip).
@pytest.mark.parametrize("joint", ["<freejoint/>", ""])
@pytest.mark.parametrize(
    ("fields", "actuators"),
    [
        ({"joint_names": "hip"}, [2]),
        ({"joint_names": ("hip", "knee")}, [1, 2, 3]),
        ({"joint_names": ("knee", "hip"), "preserve_order": True}, [1, 3, 2]),
        ({"joint_names": ".*"}, [1, 2, 3]),
        ({"joint_names": "ankle"}, []),
        ({"joint_names": ()}, []),
        ({"joint_ids": [0]}, [2]),
        ({"joint_ids": [-3]}, [2]),
        ({"joint_ids": slice(0, 1)}, [2]),
        ({"joint_ids": 0}, [2]),
        ({"joint_ids": torch.tensor([0])}, [2]),
        ({"joint_names": "hip", "actuator_names": ["pull"]}, [0]),
        ({"joint_names": "hip", "actuator_ids": [0, 1]}, [0, 1]),
        ({"body_names": "leg"}, slice(None)),
        ({}, slice(None)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*already have an actuator")
def test_actuators_follow_from_joints(joint, fields, actuators):
    scene = legs(joint)
    cfg = resolved(scene, **fields)
    assert cfg.actuator_ids == actuators
    for again in (cfg, copy.deepcopy(cfg)):
        again.resolve(scene)
        assert again.actuator_ids == actuators


@pytest.mark.parametrize("joint", ["<freejoint/>", ""])
@pytest.mark.parametrize(
    ("fields", "geoms"),
    [
        ({"body_names": "leg"}, [1, 2]),
        ({"body_names": ("shin", "trunk"), "preserve_order": True}, [3, 0]),
        ({"body_names": ("shin", "trunk")}, [0, 3]),
        ({"body_names": ".*"}, slice(None)),
        ({"body_ids": [-1]}, [3]),
        ({"body_names": ()}, []),
        ({"body_names": "leg", "geom_names": "thigh"}, [1]),
        ({"body_names": "leg", "geom_ids": slice(0, 1)}, slice(0, 1)),
        ({"joint_names": "hip"}, slice(None)),
        ({"site_names": "imu"}, slice(None)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*already have an actuator")
def test_geoms_follow_from_bodies(joint, fields, geoms):
    scene = legs(joint)
    cfg = resolved(scene, **fields)
    assert cfg.geom_ids == geoms
    for again in (cfg, copy.deepcopy(cfg)):
        again.resolve(scene)
        assert again.geom_ids == geoms


def test_all_joints_select_all_actuators():
    servo = BuiltinPositionActuatorCfg(target_names_expr=("knee",), stiffness=1.0, damping=1.0)
    scene = legs(actuators=(servo,))
    scene["robot"].spec.delete(scene["robot"].spec.actuators[0])
    assert resolved(scene, joint_names=".*").actuator_ids == slice(None)


# Terms that read ids.


def messages_of(env, cfg, kind):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for each in (cfg, cfg, copy.deepcopy(cfg)):
            columns_of(each, kind, env)
    return [str(one.message) for one in caught]


@pytest.mark.parametrize("other", KINDS)
@pytest.mark.parametrize("kind", KINDS)
def test_use_of_a_kind_not_selected_warns_once(env, kind, other):
    cfg = resolved(env.scene, **{f"{other}_names": f"{other}_a"})
    messages = messages_of(env, cfg, kind)
    if kind == other:
        assert messages == []
        return
    (message,) = messages
    for words in (f"'robot' {kind}_ids", f"{other}_a", f"every {kind}", f"{kind}_names"):
        assert words in message


@pytest.mark.parametrize(
    "fields", [{}, {"joint_names": ".*"}, {"joint_ids": [1]}, {"joint_ids": slice(0, 1)}]
)
def test_ids_that_are_meant_do_not_warn(env, fields):
    assert messages_of(env, SceneEntityCfg("robot", **fields), "joint") == []


@pytest.mark.filterwarnings("ignore:.*already have an actuator")
def test_joint_without_actuator_warns_once(env):
    scene = legs()
    env.scene.update(scene)
    (message,) = messages_of(env, resolved(scene, joint_names="ankle"), "actuator")
    for words in ("actuator_ids", "joint_names=['ankle']", "no actuator"):
        assert words in message
    assert messages_of(env, resolved(scene, joint_names=()), "actuator") == []
