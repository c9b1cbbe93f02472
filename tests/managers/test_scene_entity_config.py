"""Selections by name and by index."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest

from mjlab.managers import SceneEntityCfg
from mjlab.managers.scene_entity_config import selections_checked

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


# Ids that were never resolved.


@pytest.mark.parametrize("kind", KINDS)
def test_unresolved_ids_are_an_error_while_terms_run(env, kind):
    cfg = SceneEntityCfg("robot", **{f"{kind}_names": f"{kind}_b"})
    with (
        selections_checked(env.scene),
        pytest.raises(
            ValueError, match=f"'robot' {kind}_ids: .*{kind}_names='{kind}_b'.*parameter"
        ),
    ):
        getattr(cfg, f"{kind}_ids")
    assert getattr(cfg, f"{kind}_ids") == slice(None), "no term runs"


def test_ids_that_select_what_their_names_say_can_be_read(env):
    everything = SceneEntityCfg("robot", joint_names="joint_.*")
    resolved = SceneEntityCfg("robot", joint_names="joint_b")
    resolved.resolve(env.scene)
    # The fields of a kind do not concern another kind.
    bodies = SceneEntityCfg("robot", joint_names="joint_b")
    with selections_checked(env.scene):
        assert everything.joint_ids == slice(None)
        assert resolved.joint_ids == copy.deepcopy(resolved).joint_ids == [1]
        assert bodies.body_ids == slice(None)
        bodies.resolve(env.scene)
        assert bodies.joint_ids == [1]


def test_unresolved_selections_can_be_copied_compared_and_printed_while_terms_run(env):
    cfg = SceneEntityCfg("robot", joint_names="joint_b")
    with selections_checked(env.scene):
        for same in (
            copy.deepcopy(cfg),
            dataclasses.replace(cfg),
            SceneEntityCfg(**dataclasses.asdict(cfg)),
            pickle.loads(pickle.dumps(cfg)),
        ):
            assert same == cfg
            assert repr(same) == repr(cfg)


def test_checks_of_several_scenes_nest(env):
    cfg = SceneEntityCfg("robot", joint_names="joint_b")
    with selections_checked(env.scene):
        with selections_checked(None):
            assert cfg.joint_ids == slice(None)
        with pytest.raises(ValueError, match="joint_ids"):
            _ = cfg.joint_ids
