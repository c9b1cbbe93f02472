"""Environments with variants behave as each would with its own variant alone, on both engines."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityCfg, VariantEntityCfg
from mjlab.envs.mdp import dr
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.scene import Scene
from mjlab.sim import Simulation
from mjlab.sim.sim import VARIANT_DEPENDENT_FIELDS
from mjlab.utils.spec_config import CollisionCfg

from .variant_objects import BEADS, THINGS, make_scene, place, plain, present_geoms, simulate, thing

ENGINES = ("native", "warp")
THING = VariantEntityCfg(variants=THINGS, assignment=lambda n: [(2 * i) % 5 for i in range(n)])
BEAD = VariantEntityCfg(variants=BEADS)
NUM_ENVS = 7
# Every thing with the small bead and two with the large one.
COMBINATIONS = [((2 * i) % 5, int(i > 3)) for i in range(NUM_ENVS)]


@functools.cache
def world(engine: str) -> tuple[Simulation, Scene]:
    """Return one simulation of all variants, which tests share: building it costs the most."""
    scene = make_scene(NUM_ENVS, {"thing": THING, "bead": BEAD})
    return simulate(scene, engine), scene


@functools.cache
def alone(env: int, engine: str = "native") -> Simulation:
    """Return a simulation of what an environment holds, and nothing else."""
    kind, bead = COMBINATIONS[env]
    entities = {
        "thing": plain(list(THINGS.values())[kind]),
        "bead": plain(list(BEADS.values())[bead]),
    }
    return simulate(make_scene(1, entities), engine)


def test_environments_are_assigned_as_asked() -> None:
    sim, _ = world("native")
    found = sim.world_to_variant
    assert found["thing"].tolist() == [kind for kind, _ in COMBINATIONS]
    assert found["bead"].tolist() == [bead for _, bead in COMBINATIONS]


@pytest.mark.parametrize("engine", ENGINES)
def test_every_environment_has_the_inertia_of_its_variants_compiled_alone(engine: str) -> None:
    sim, _ = world(engine)
    names = ("mass", "subtreemass", "inertia", "invweight0", "ipos")
    for env in range(NUM_ENVS):
        reference = alone(env).mj_model
        for name in names:
            field = f"body_{name}"
            expected = getattr(reference, field)
            found = getattr(sim.model, field)[env].numpy()
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8, err_msg=field)
            default = sim.get_default_field(field)[env].numpy()
            np.testing.assert_array_equal(found, default, err_msg=field)
        assert np.abs((sim.model.body_iquat[env].numpy() * reference.body_iquat).sum(-1)).min() > (
            1 - 1e-6
        )
        for field in ("dof_invweight0", "dof_armature"):
            expected = getattr(reference, field)
            np.testing.assert_allclose(getattr(sim.model, field)[env], expected, rtol=1e-5)


def _rounded(values: Any) -> list[float]:
    return np.ravel(values).astype(float).round(5).tolist()


@pytest.mark.parametrize("engine", ENGINES)
def test_every_environment_has_the_geoms_of_its_variants_with_their_bounds(engine: str) -> None:
    sim, _ = world(engine)
    model = sim.mj_model
    shared = ("type", "condim", "contype", "conaffinity", "group", "priority")
    fields = ("size", "rbound", "aabb", "pos", "friction", "rgba")
    fields += ("solref", "solimp", "solmix", "margin", "gap")
    seen = {name: set() for name in (*shared, *fields)}
    for env in range(NUM_ENVS):
        reference = alone(env).mj_model
        for body in ("thing/thing", "thing/lid", "bead/bead"):
            ids = present_geoms(sim, env, body)
            expected_ids = present_geoms(alone(env), 0, body)
            assert len(ids) == len(expected_ids)
            found, expected = (
                sorted(
                    [
                        tuple(int(getattr(m, f"geom_{name}")[i]) for name in shared),
                        *(_rounded(get(f"geom_{name}", i)) for name in fields),
                    ]
                    for i in chosen
                )
                for m, get, chosen in (
                    (model, lambda f, i, e=env: getattr(sim.model, f)[e, i].numpy(), ids),
                    (reference, lambda f, i, r=reference: getattr(r, f)[i], expected_ids),
                )
            )
            assert str(found) == str(expected)
            for values, *more in expected if body == "thing/thing" else ():
                for name, value in zip(seen, (*values, *more), strict=True):
                    seen[name].add(str(value))
    # With equal variants, nothing would be compared.
    assert {name for name, values in seen.items() if len(values) == 1} == set()
    assert sim.absent_geoms is not None
    assert (sim.model.geom_rgba[sim.absent_geoms][:, 3] == 0).all()
    meshes = torch.as_tensor(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    assert ((sim.model.geom_dataid < 0) == (sim.absent_geoms | ~meshes)).all()


def tumbling(sim: Simulation) -> None:
    """Start things tilted and turning above a bead, the same way wherever they are."""
    rng = np.random.default_rng(3)
    tilt = rng.normal(size=4)
    qvel = torch.as_tensor(rng.normal(size=sim.mj_model.nv), dtype=torch.float32)
    qpos = torch.zeros(sim.mj_model.nq)
    qpos[:3] = torch.tensor([0.0, 0.0, 0.45])
    qpos[3:7] = torch.as_tensor(tilt / np.linalg.norm(tilt))
    qpos[8:15] = torch.tensor([0.03, 0.02, 0.1, 1.0, 0.0, 0.0, 0.0])
    place(sim, qpos)
    sim.data.qvel[:] = qvel


@pytest.mark.parametrize("engine", ENGINES)
def test_each_falls_and_hits_the_ground_as_it_would_alone(engine: str) -> None:
    sim, _ = world(engine)
    tumbling(sim)
    sim.step(60)
    for env in range(NUM_ENVS - 2):
        reference = alone(env, engine)
        tumbling(reference)
        reference.step(60)
        expected = reference.data.qpos[0]
        assert expected[2] < 0.25
        torch.testing.assert_close(sim.data.qpos[env], expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_comes_to_rest_at_its_own_height(engine: str) -> None:
    sim, _ = world(engine)
    qpos = torch.zeros(sim.mj_model.nq)
    qpos[2], qpos[3], qpos[10], qpos[8], qpos[11] = 0.16, 1.0, 0.06, 1.0, 1.0
    place(sim, qpos)
    sim.step(100)
    sim.step(100)
    thing_z, bead_z = sim.data.qpos[:, 2], sim.data.qpos[:, 10]
    heights = torch.tensor([{0: 0.1, 1: 0.15, 3: 0.0}.get(kind, -1.0) for kind, _ in COMBINATIONS])
    known = heights >= 0
    assert known.sum() == 4
    torch.testing.assert_close(thing_z[known], heights[known], atol=2e-3, rtol=0)
    sizes = torch.tensor([(0.03, 0.05)[bead] for _, bead in COMBINATIONS])
    torch.testing.assert_close(bead_z, sizes, atol=2e-3, rtol=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_rays_see_what_the_environment_holds(engine: str) -> None:
    sim, _ = world(engine)
    tumbling(sim)
    rng = np.random.default_rng(0)
    origins = torch.as_tensor(rng.uniform(-0.3, 0.3, size=(NUM_ENVS, 40, 3)), dtype=torch.float32)
    origins[..., 2] = 1.0
    directions = torch.zeros_like(origins)
    directions[..., 2] = -1.0
    distances, normals, _ = sim.raycast(origins, directions)
    hits = 0
    for env in range(NUM_ENVS):
        reference, row = alone(env), slice(env, env + 1)
        tumbling(reference)
        expected, expected_normals, _ = reference.raycast(origins[row], directions[row])
        torch.testing.assert_close(distances[env], expected[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(normals[env], expected_normals[0], atol=1e-3, rtol=0)
        hits += int((expected < 0.99).sum())
    assert hits > 25


@pytest.mark.parametrize("engine", ENGINES)
def test_a_geom_that_is_not_there_touches_nothing_whatever_its_size(engine: str) -> None:
    sim, _ = world(engine)
    absent = sim.absent_geoms
    assert absent is not None
    # Everything starts in one place, where bounds in one place would be found to touch.
    qpos = torch.zeros(sim.mj_model.nq)
    qpos[2], qpos[3], qpos[10], qpos[11] = 2.0, 1.0, 0.05, 1.0

    def run() -> torch.Tensor:
        place(sim, qpos)
        sim.step(40)
        return sim.data.qpos.clone()

    before = run()
    # The bounds are what keeps geoms apart on Warp.
    names = ("geom_size",) if engine == "warp" else ("geom_size", "geom_rbound", "geom_aabb")
    saved = {name: getattr(sim.model, name).clone() for name in names}
    spheres = torch.as_tensor(sim.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    for name in names:
        field = getattr(sim.model, name)
        (field[..., 3:] if name == "geom_aabb" else field)[absent & spheres] = 3.0
    try:
        torch.testing.assert_close(run(), before, rtol=0, atol=0)
    finally:
        for name, values in saved.items():
            getattr(sim.model, name).copy_(values)


def test_both_engines_hold_the_same_values_and_agree_on_which_are_defaults() -> None:
    native, warp = world("native")[0], world("warp")[0]
    shared = native.per_world_default_fields & warp.per_world_default_fields
    assert set(VARIANT_DEPENDENT_FIELDS) <= shared
    assert {"geom_dataid", "geom_matid", "geom_friction", "geom_solref", "dof_armature"} <= shared
    for name in shared:
        a, b = native.get_default_field(name), warp.get_default_field(name)
        assert a.shape[0] == NUM_ENVS
        assert torch.equal(a, b), name
    assert native.expanded_fields >= native.per_world_default_fields


@pytest.mark.parametrize("engine", ENGINES)
def test_saved_simulations_go_on_as_they_would_have(engine: str) -> None:
    sim, _ = world(engine)
    tumbling(sim)
    sim.step(30)
    state = sim.state_dict()
    sim.step(10)
    expected = sim.data.qpos.clone()
    sim.load_state_dict(state)
    sim.step(10)
    torch.testing.assert_close(sim.data.qpos, expected, atol=1e-6, rtol=0)


# Randomization.


class Env:
    """Environment as seen by randomization functions."""

    def __init__(self, engine: str) -> None:
        cfg = VariantEntityCfg(variants=THINGS)
        self.scene = make_scene(5, {"thing": cfg})
        self.sim = simulate(self.scene, engine)
        self.num_envs, self.device = 5, "cpu"

    def apply(self, term: Any, **params: Any) -> None:
        params["asset_cfg"].resolve(self.scene)
        self.sim.expand_model_fields(term.model_fields)
        term(self, None, **params)
        self.sim.recompute_constants(term.recompute)


@functools.cache
def randomized(engine: str) -> Env:
    return Env(engine)


@pytest.mark.filterwarnings("ignore:dr.body_mass")
@pytest.mark.parametrize("engine", ENGINES)
def test_randomization_starts_from_the_values_of_each_variant(engine: str) -> None:
    env = randomized(engine)
    masses = env.sim.model.body_mass.clone()
    assert len(masses[:, 2].unique()) == 5
    for _ in range(2):
        env.apply(
            dr.body_mass,
            ranges=(2.0, 2.0),
            operation="scale",
            asset_cfg=SceneEntityCfg("thing", body_names=("thing",)),
        )
    expected = masses.clone()
    expected[:, 2] *= 2.0
    torch.testing.assert_close(env.sim.model.body_mass, expected)
    torch.testing.assert_close(env.sim.model.body_subtreemass[:, 0], expected.sum(dim=1))
    env.apply(dr.pseudo_inertia, alpha_range=(0.0, 0.0), asset_cfg=SceneEntityCfg("thing"))
    torch.testing.assert_close(env.sim.model.body_mass, masses)


@pytest.mark.parametrize("engine", ENGINES)
def test_randomizing_geoms_does_not_bring_back_those_that_are_not_there(engine: str) -> None:
    env = randomized(engine)
    absent = env.sim.absent_geoms
    assert absent is not None
    fields = ("geom_size", "geom_rbound", "geom_aabb", "geom_rgba", "geom_pos", "geom_quat")
    before = {name: getattr(env.sim.model, name).clone() for name in fields}
    spheres = SceneEntityCfg("thing", geom_names=("mjlab/pad/thing/collision/[012]",))
    env.apply(dr.geom_size, ranges=(0.2, 0.3), operation="abs", asset_cfg=spheres)
    env.apply(dr.geom_rgba, ranges=(0.5, 1.0), asset_cfg=SceneEntityCfg("thing"))
    env.apply(dr.geom_pos, ranges=(0.1, 0.2), asset_cfg=SceneEntityCfg("thing"))
    env.apply(dr.geom_quat, roll_range=(0.1, 0.2), asset_cfg=SceneEntityCfg("thing"))
    present = ~absent
    present[:, 0] = False
    for name in fields:
        after = getattr(env.sim.model, name)
        assert torch.equal(after[absent], before[name][absent]), name
        assert not torch.equal(after[present], before[name][present]), name
    boxes = env.sim.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    assert boxes.any()


# Unsupported by engines.


def limited_things() -> dict[str, Any]:
    hinge = '<joint name="hinge"'
    limited = {hinge: f'{hinge} limited="true" range="-20 20"'}
    geom = '<geom name="shell" size=".1"/>'
    return {"free": thing("free", geom), "limited": thing("limited", geom, **limited)}


def test_limits_of_joints_differ_where_the_engine_allows() -> None:
    cfg = VariantEntityCfg(variants=limited_things())
    scene = make_scene(2, {"thing": cfg})
    simulate(scene, "native")
    limits = scene["thing"].data.joint_pos_limits[:, 0]
    torch.testing.assert_close(limits[1], torch.tensor([-20.0, 20.0]).deg2rad())
    assert limits[0].isinf().all()
    with pytest.warns(UserWarning, match="entity 'thing' differ in .*'jnt_limited'.*native"):
        shared = simulate(make_scene(2, {"thing": cfg}), "warp")
    assert not shared.model.jnt_limited.any()
    assert shared.model.jnt_range[1, -1].tolist() == pytest.approx(limits[1].tolist())


def test_a_search_for_contacts_that_ignores_planes_or_boxes_is_refused() -> None:
    scene = make_scene(2, {"thing": VariantEntityCfg(variants=THINGS, assignment={"mesh": 0.0})})
    with pytest.raises(ValueError, match="broadphase_filter.*'plane'.*native"):
        simulate(scene, "warp", broadphase_filter=("plane", "sphere"))


def test_variants_are_refused_with_a_model_whose_inertia_is_fixed() -> None:
    scene = make_scene(2, {"bead": BEAD})
    model = scene.compile()
    with pytest.raises(ValueError, match="body_ipos.*Simulation.*spec="):
        Simulation(
            2,
            replace(world("native")[0].cfg),
            model=model,
            device="cpu",
            variant_info=scene.collect_variant_info(),
        )


@pytest.mark.parametrize("engine", ENGINES)
def test_collision_settings_of_the_config_count_in_every_variant(engine: str) -> None:
    friction = CollisionCfg(
        geom_names_expr=("shell",), contype=1, conaffinity=1, condim=3, priority=1, friction=(0.7,)
    )
    names = {name: THINGS[name] for name in ("box", "ball")}
    cfg = VariantEntityCfg(variants=names, collisions=(friction,))
    sim = simulate(make_scene(2, {"thing": cfg}), engine)
    for env in range(2):
        (geom,) = present_geoms(sim, env, "thing/thing")
        assert float(sim.model.geom_friction[env, geom, 0]) == pytest.approx(0.7)
        assert sim.mj_model.geom_priority[geom] == 1


def test_one_simulation_for_warp_alone_has_the_same_values() -> None:
    from mjlab.entity.variants import build_variant_model

    scene = make_scene(NUM_ENVS, {"thing": THING, "bead": BEAD})
    seen = []
    result = build_variant_model(
        scene.spec, NUM_ENVS, scene.collect_variant_info(), lambda m: seen.append(m.ngeom)
    )
    assert seen == [result.mj_model.ngeom]
    assert result.world_to_variant["thing"].tolist() == [kind for kind, _ in COMBINATIONS]
    sim = world("warp")[0]
    for name in ("geom_size", "geom_rbound", "geom_aabb", "body_mass", "body_inertia"):
        values = getattr(result.wp_model, name).numpy().reshape(getattr(sim.model, name).shape)
        np.testing.assert_array_equal(values, getattr(sim.model, name).numpy())
    # Without the shortcut for free bodies, whose centers of mass differ between worlds.
    np.testing.assert_array_equal(result.mj_model.body_simple, sim.mj_model.body_simple)
    np.testing.assert_array_equal(result.mj_model.M_rownnz, sim.mj_model.M_rownnz)


def test_plain_entities_have_no_variants() -> None:
    scene = make_scene(2, {"bead": EntityCfg(spec_fn=BEADS["small"])})
    assert scene["bead"].variant_metadata is None
    sim = simulate(scene)
    assert sim.world_to_variant == {}
    assert sim.per_world_default_fields == set()
    assert sim.absent_geoms is None
    assert sim.get_default_field("geom_size").ndim == 2
