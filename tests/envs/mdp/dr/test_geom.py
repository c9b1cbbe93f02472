"""Randomization of geoms."""

from __future__ import annotations

from typing import Any

import mujoco
import pytest
import torch

from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg

ENGINES = ("native", "warp")
PRIMITIVES = ("box", "sphere", "capsule", "cylinder", "ellipsoid")


@pytest.mark.parametrize("engine", ENGINES)
def test_geom_size_keeps_bounds_that_the_compiler_would_compute(
    make_world: Any, engine: str
) -> None:
    world = make_world(engine=engine)
    chosen = SceneEntityCfg("robot", geom_names=PRIMITIVES)
    world.apply(dr.geom_size, ranges=(1.0, 1.0), asset_cfg=chosen)
    primitives = world.sim.mj_model.geom_type != mujoco.mjtGeom.mjGEOM_MESH
    for field in ("geom_size", "geom_rbound", "geom_aabb"):
        default = world.sim.get_default_field(field)[primitives]
        now = getattr(world.sim.model, field)[:, primitives]
        torch.testing.assert_close(now, default.expand_as(now), msg=field)
    world.apply(dr.geom_size, torch.tensor([0]), ranges=(2.0, 2.0), asset_cfg=chosen)
    for field, factor in (("geom_rbound", 2.0), ("geom_aabb", 2.0)):
        default = world.sim.get_default_field(field)[primitives]
        torch.testing.assert_close(
            getattr(world.sim.model, field)[0, primitives], factor * default, msg=field
        )
        torch.testing.assert_close(getattr(world.sim.model, field)[1, primitives], default)


def test_geom_size_checks_before_it_writes(make_world: Any) -> None:
    world = make_world()
    with pytest.raises(ValueError, match=r"geom_size: .*\{'tetra': 'mesh'\}"):
        world.apply(dr.geom_size, ranges=(2.0, 2.0))
    with pytest.raises(ValueError, match="tetra"):
        world.apply(dr.geom_size, ranges={"box": (2.0, 2.0), "tetra": (2.0, 2.0)})
    default = world.sim.get_default_field("geom_size")
    assert torch.equal(world.sim.model.geom_size, default.expand(4, *default.shape))


def test_geom_size_with_patterns_leaves_other_geoms_alone(make_world: Any) -> None:
    # The config selects a mesh; the patterns leave it out.
    world = make_world()
    world.apply(dr.geom_size, ranges={"sphere": (3.0, 3.0)})
    assert world.sim.model.geom_rbound[0, 1] == pytest.approx(0.3)
    assert world.sim.model.geom_rbound[0, 0] == pytest.approx(world.sim.mj_model.geom_rbound[0])


def test_geom_size_bounds_are_those_of_their_own_environment_and_geom(make_world: Any) -> None:
    """More geoms than environments, of types in turn, and a part of both: no grid fits by luck."""
    xml = (
        """<mujoco><worldbody><body name="b"><freejoint/>"""
        + "".join(
            f'<geom name="{kind}{k}" type="{kind}" size=".1 .2 .3"/>'
            for k in range(2)
            for kind in PRIMITIVES
        )
        + "</body></worldbody></mujoco>"
    )
    world = make_world(xml, num_envs=5)
    model, envs = world.sim.model, torch.tensor([1, 3, 4])
    chosen = SceneEntityCfg("robot", geom_names=("sphere.", "box1", "capsule.", "ellipsoid0"))
    world.apply(dr.geom_size, envs, ranges=(0.5, 2.0), asset_cfg=chosen)
    changed = model.geom_size != world.sim.get_default_field("geom_size")
    assert changed.any(dim=2).sum(dim=1).tolist() == [0, 6, 0, 6, 6]
    for env in range(5):
        spec = mujoco.MjSpec.from_string(xml)
        for geom in range(10):
            spec.geoms[geom].size = model.geom_size[env, geom].double()
        built = spec.compile()
        for field in ("geom_rbound", "geom_aabb"):
            expected = torch.as_tensor(getattr(built, field)).float()
            now = getattr(model, field)[env].reshape(expected.shape)
            torch.testing.assert_close(now, expected, msg=f"{field} of environment {env}")


@pytest.mark.parametrize("engine", ENGINES)
def test_geom_matid_chooses_among_the_selected_materials(make_world: Any, engine: str) -> None:
    world = make_world(engine=engine, num_envs=16)
    chosen = SceneEntityCfg("robot", geom_names=("box", "sphere"), material_names=("mat_.*",))
    world.apply(dr.geom_matid, asset_cfg=chosen)
    ids = world.sim.model.geom_matid
    assert sorted(ids[:, :2].unique().tolist()) == [0, 1]
    assert bool((ids[:, 2:] == -1).all())
    world.apply(dr.geom_matid, asset_cfg=chosen, shared_random=True)
    assert torch.equal(ids[:, 0], ids[:, 1])


def test_an_empty_choice_is_refused(make_world: Any) -> None:
    with pytest.raises(ValueError, match="material_names"):
        make_world().apply(dr.geom_matid, asset_cfg=SceneEntityCfg("robot", material_names=()))
