"""Selections of one kind of element, read by terms of another."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch

from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg

TABLE = {f.row.name: f.row for f in vars(dr).values() if hasattr(f, "row")}
# Names of one element of each kind that the robot of these tests has.
ONE = {"site": "imu", "camera": "eye", "light": "lamp", "tendon": "cable", "joint": "knee"}


def selection(kind: str, name: str) -> SceneEntityCfg:
    return SceneEntityCfg("robot", **{f"{kind}_names": (name,)})


def run(world: Any, name: str, cfg: SceneEntityCfg, ids: torch.Tensor | None = None) -> list[str]:
    angles = {"roll_range": (0.1, 0.2)}
    params = angles if TABLE[name].rotation else {"ranges": (1.1, 1.3), "operation": "scale"}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for _ in range(2):
            world.apply(getattr(dr, name), ids, asset_cfg=cfg, **params)
    return [str(one.message) for one in caught if str(one.message).startswith("SceneEntityCfg")]


@pytest.mark.parametrize("name", sorted(set(TABLE) - {"geom_size"}))
def test_rows_warn_of_a_selection_of_another_kind(make_world: Any, name: str) -> None:
    world, kind = make_world(), TABLE[name].kind.name
    other = next(one for one in ONE if one != kind)
    (message,) = run(world, name, selection(other, ONE[other]))
    for words in (f"'robot' {kind}_ids", f"{other}_names=['{ONE[other]}']", f"every {kind}"):
        assert words in message
    everything = SceneEntityCfg("robot", **{f"{kind}_names": ".*"})
    own = getattr(world.robot, f"{kind}_names")
    assert run(make_world(), name, everything if own else SceneEntityCfg("robot")) == []


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("name", ["geom_friction", "geom_pos", "geom_quat", "geom_rgba"])
def test_bodies_select_their_geoms(make_world: Any, name: str, engine: str) -> None:
    world = make_world(engine=engine)
    world.sim.expand_model_fields(TABLE[name].fields)
    before = getattr(world.sim.model, TABLE[name].field).clone()
    chosen = SceneEntityCfg("robot", body_names=("shin", "torso"))
    assert run(world, name, chosen, torch.tensor([1])) == []
    changed = (getattr(world.sim.model, TABLE[name].field) != before).flatten(2).any(dim=2)
    names = [world.robot.geom_names[i] for i in changed[1].nonzero().flatten().tolist()]
    # A scaled position of zero is zero.
    assert set(names) <= {"box", "sphere", "tetra", "cylinder"}
    assert len(names) == (2 if name == "geom_pos" else 4)
    assert not changed[[0, 2, 3]].any()


def test_bodies_select_the_geoms_to_resize(make_world: Any) -> None:
    world = make_world()
    chosen = SceneEntityCfg("robot", body_names=("shin", "foot"))
    world.apply(dr.geom_size, ranges=(2.0, 2.0), asset_cfg=chosen)
    factors = world.sim.model.geom_size[0] / world.sim.get_default_field("geom_size")
    assert [bool((factor == 2.0).any()) for factor in factors] == [False] * 4 + [True, True]


def test_bodies_select_geoms_for_materials(make_world: Any) -> None:
    world = make_world()
    chosen = SceneEntityCfg("robot", body_names=("shin",), material_names=("mat_b",))
    world.apply(dr.geom_matid, asset_cfg=chosen)
    ids = world.sim.model.geom_matid[0].tolist()
    assert ids == [0, -1, -1, -1, 1, -1]


def test_name_patterns_do_not_read_the_selection(make_world: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chosen = selection("joint", "knee")
        make_world().apply(dr.geom_friction, ranges={"box": (0.5, 0.6)}, asset_cfg=chosen)
