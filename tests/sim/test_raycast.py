"""What rays meet, on both engines, and that looking only at what is near changes nothing."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.sim import Simulation, SimulationCfg

ENGINES = ("native", "warp")
DOWN, UP = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)

SHAPES = """
<mujoco>
  <asset>
    <mesh name="cube" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 1 1 -1 -1 -1 1 1 -1 1 -1 1 1 1 1 1"/>
    <hfield name="hill" nrow="5" ncol="5" size="2 2 1 .5"
      elevation="0 0 0 0 0  0 1 1 1 0  0 1 1 1 0  0 1 1 1 0  0 0 0 0 0"/>
    <material name="glass" rgba="1 1 1 0"/>
    <material name="steel" rgba="1 1 1 1"/>
  </asset>
  <worldbody>
    <geom name="plane" type="plane" size="1 1 .1"/>
    <geom name="box" type="box" size="1 1 1" pos="10 0 0"/>
    <geom name="sphere" type="sphere" size="1" pos="20 0 0"/>
    <geom name="capsule" type="capsule" size="1 1" pos="30 0 0"/>
    <geom name="cylinder" type="cylinder" size="1 1" pos="40 0 0"/>
    <geom name="ellipsoid" type="ellipsoid" size="1 1 1.5" pos="50 0 0"/>
    <geom name="mesh" type="mesh" mesh="cube" pos="60 0 0"/>
    <geom name="hill" type="hfield" hfield="hill" pos="70 0 0"/>
    <geom name="clear" type="box" size="1 1 1" pos="80 0 0" rgba="1 1 1 0"/>
    <geom name="glazed" type="box" size="1 1 1" pos="90 0 0" material="glass"/>
    <geom name="plated" type="box" size="1 1 1" pos="100 0 0" rgba="1 1 1 0" material="steel"/>
    <geom name="far" type="box" size="1 1 1" pos="110 0 0" group="9"/>
    <body name="ball" pos="0 50 0"><freejoint/><geom size=".1"/></body>
  </worldbody>
</mujoco>
"""
# Place along x, start height, direction; distance and normal's z, or None for a miss.
CASES = {
    "a plane from above": (0, 2.0, DOWN, 2.0, 1.0),
    "a plane from below": (0, -2.0, UP, None, 0.0),
    "beyond a plane's edge": (1.5, 2.0, DOWN, None, 0.0),
    "a box from outside": (10, 3.0, DOWN, 2.0, 1.0),
    "a box from inside": (10, 0.5, DOWN, 1.5, -1.0),
    "a sphere from inside": (20, 0.5, DOWN, 1.5, -1.0),
    "a capsule from inside": (30, 0.5, DOWN, 2.5, -1.0),
    "a cylinder from inside": (40, 0.5, UP, 0.5, 1.0),
    "an ellipsoid from inside": (50, 0.0, UP, 1.5, 1.0),
    "a mesh from above": (60, 3.0, DOWN, 2.0, 1.0),
    "a mesh from below": (60, -3.0, UP, 2.0, -1.0),
    "a mesh from inside": (60, 0.5, DOWN, None, 0.0),
    "a mesh from inside, sideways": (60, 0.5, (0.6, 0.0, 0.8), None, 0.0),
    "a height field from above": (70, 3.0, DOWN, 2.0, 1.0),
    "a height field from inside, down to its base": (70, 0.5, DOWN, None, 0.0),
    "a height field from inside, up to its surface": (70, 0.5, UP, None, 0.0),
    "a height field from inside its base": (70, -0.2, UP, None, 0.0),
    "a height field from inside its base, down": (70, -0.2, DOWN, None, 0.0),
    "a height field from below": (70, -3.0, UP, None, 0.0),
    "the side of a height field's base": (73, -0.2, (-1.0, 0.0, 0.0), None, 0.0),
    "the slope of a height field": (73, 0.25, (-1.0, 0.0, 0.0), 1.25, 0.70710678),
    "out through the slope of a height field": (70, 0.5, (1.0, 0.0, 0.0), None, 0.0),
    "a transparent geom": (80, 3.0, DOWN, None, 0.0),
    "a geom of transparent material": (90, 3.0, DOWN, None, 0.0),
    "a transparent geom of opaque material": (100, 3.0, DOWN, 2.0, 1.0),
    "a geom of a group beyond 5": (110, 3.0, DOWN, 2.0, 1.0),
}


@pytest.fixture(scope="module", params=ENGINES)
def shapes(request):
    model = mujoco.MjModel.from_xml_string(SHAPES)
    return Simulation(2, SimulationCfg(engine=request.param), model=model, device="cpu")


def rays(*pairs) -> tuple[torch.Tensor, torch.Tensor]:
    """Start and direction of each ray, in both environments."""
    starts, directions = zip(*pairs, strict=True)
    return (
        torch.tensor(starts, dtype=torch.float32).repeat(2, 1, 1),
        torch.tensor(directions, dtype=torch.float32).repeat(2, 1, 1),
    )


def test_surfaces_are_met_from_the_sides_from_which_they_are_there(shapes):
    origins, directions = rays(
        *[((x + 0.01, 0.02, z), direction) for x, z, direction, _, _ in CASES.values()]
    )
    reach = torch.full((len(CASES),), 5.0)
    distances, normals, geoms = shapes.raycast(origins, directions, None, None, reach)
    for i, (name, (_, _, _, expected, up)) in enumerate(CASES.items()):
        distance = distances[1, i].item()
        # The offset from the middle matters on round and on sloping surfaces.
        assert distance == pytest.approx(-1.0 if expected is None else expected, abs=0.02), name
        assert normals[1, i, 2].item() == pytest.approx(up, abs=1e-3), name
        assert (geoms[1, i] < 0) == (expected is None), name
        assert normals[1, i].norm().item() == pytest.approx(float(expected is not None)), name


def test_flat_ground_of_a_height_field_is_not_taken_for_its_base(shapes):
    origins, directions = rays(((71.99, 1.99, 3.0), DOWN), ((71.99, 1.99, 0.01), DOWN))
    distances, normals, _ = shapes.raycast(origins, directions)
    torch.testing.assert_close(distances[0], torch.tensor([2.99, 0.0]), atol=0.02, rtol=0)
    assert (normals[0, :, 2] > 0.5).all()


def test_what_lies_behind_a_surface_that_is_not_there_is_met():
    # Inside the mesh there is a ball, and below the height field a floor.
    xml = SHAPES.replace(
        "<body name=",
        '<geom size=".1" pos="60 0 -.5"/><geom type="plane" size="99 9 1" '
        'pos="70 0 -4"/><body name=',
    )
    for engine in ENGINES:
        model = mujoco.MjModel.from_xml_string(xml)
        sim = Simulation(2, SimulationCfg(engine=engine), model=model, device="cpu")
        origins, directions = rays(
            *[((60.0, 0.0, 0.5), DOWN), ((60.3, 0.2, 0.5), DOWN)],
            *[((70.1, 0.1, 0.5), DOWN), ((70.1, 0.1, 3.0), DOWN)],
        )
        distances, normals, _ = sim.raycast(origins, directions)
        expected = torch.tensor([0.9, 4.5, 4.5, 2.0]).repeat(2, 1)
        torch.testing.assert_close(distances, expected, atol=1e-4, rtol=0)
        torch.testing.assert_close(normals[..., 2], torch.ones(2, 4))


def test_groups_beyond_the_range_count_as_the_nearest(shapes):
    origins, directions = rays(((110.0, 0.0, 3.0), DOWN), ((10.0, 0.0, 3.0), DOWN))
    for groups, expected in (((5,), [2.0, -1.0]), ((0,), [-1.0, 2.0]), ((3,), [-1.0, -1.0])):
        distances, _, geoms = shapes.raycast(origins, directions, groups)
        assert distances[0].tolist() == pytest.approx(expected)
        assert (geoms[0] >= 0).tolist() == [d > 0 for d in expected]


def test_a_reach_and_an_excluded_body_are_each_rays_own(shapes):
    above = ((0.0, 50.0, 1.0), DOWN)
    origins, directions = rays(above, above, above, above)
    ball = shapes.mj_model.body("ball").id
    excluded = torch.tensor([-1, ball, -1, -1], dtype=torch.int32)
    reach = torch.tensor([5.0, 5.0, 0.89, 0.91])
    distances, normals, geoms = shapes.raycast(origins, directions, None, excluded, reach)
    assert distances[1].tolist() == pytest.approx([0.9, -1.0, -1.0, 0.9], abs=1e-5)
    assert geoms[1].tolist()[1:3] == [-1, -1]
    assert (normals[1, 1:3] == 0).all()


@pytest.mark.parametrize("on_cuda", [False, pytest.param(True, marks=pytest.mark.cuda)])
def test_both_engines_meet_the_same_on_any_ray(on_cuda, cuda_device):
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(2, 3000, 3, generator=generator)
    origins[..., 0] += 10 * torch.randint(0, 12, (3000,), generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(2, 3000, 3, generator=generator), dim=-1)
    results = []
    for engine, device in (("native", "cpu"), ("warp", cuda_device if on_cuda else "cpu")):
        model = mujoco.MjModel.from_xml_string(SHAPES)
        sim = Simulation(2, SimulationCfg(engine=engine), model=model, device=device)
        hits = sim.raycast(origins.to(device), directions.to(device))
        results.append([values.cpu() for values in hits])
    (native, native_normals, _), (warp, warp_normals, _) = results
    apart = (native - warp).abs() > 1e-3
    # A ray along an edge may pass on either side of it.
    assert apart.float().mean() < 2e-3
    assert (native >= 0).float().mean() > 0.2
    close = ~apart & ((native_normals - warp_normals).abs().amax(-1) < 2e-2)
    assert close.float().mean() > 0.995


# Only what is near.


def terrain_model(turned: bool, moving: bool, hills: bool, meshes: bool = False) -> mujoco.MjModel:
    """Blocks, drums, hills and rocks in rows, with something that moves above them."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    kinds = [mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -0.4])
    for i in range(12):
        for j in range(12):
            geom = spec.worldbody.add_geom(
                type=kinds[rng.integers(2)],
                size=[0.25, 0.25, 0.3],
                pos=[0.5 * i - 3, 0.5 * j - 3, 0.2 * rng.random()],
            )
            if turned:
                geom.alt.euler = list(rng.uniform(-20, 20, 3))
    if hills:
        for k in range(2):
            heights = rng.random(400).astype(np.float32)
            spec.add_hfield(name=f"h{k}", nrow=20, ncol=20, size=[1, 1, 0.4, 0.2], userdata=heights)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=f"h{k}", pos=[4.0 + 2 * k, 0, 0]
            )
    for k in range(8 * meshes):
        spec.add_mesh(name=f"rock{k}", uservert=rng.uniform(-0.5, 0.5, 36))
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"rock{k}",
            pos=[k - 3, 3.5, 0.1 * k],
            quat=rng.normal(size=4),
        )
    body = spec.worldbody.add_body(name="body", pos=[0, 0, 1])
    body.add_freejoint()
    body.add_geom(size=[0.05, 0.05, 0.05], group=0 if moving else 2)
    return spec.compile()


def mj_ray(model, data, origin, direction, groups, exclude) -> tuple[float, np.ndarray]:
    return mj_ray_hit(model, data, origin, direction, groups, exclude)[:2]


def mj_ray_hit(model, data, origin, direction, groups, exclude=-1) -> tuple[float, np.ndarray, int]:
    normal, geom = np.zeros(3), np.array([-1], dtype=np.int32)
    mask = None if groups is None else np.isin(np.arange(6), groups).astype(np.uint8)
    distance = mujoco.mj_ray(
        model, data, origin.astype(float), direction.astype(float), mask, 1, exclude, geom, normal
    )
    return distance, normal, int(geom[0])


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("moving", [False, True])
def test_rays_against_what_is_near_are_those_of_mj_ray_against_everything(turned, moving):
    model = terrain_model(turned, moving, hills=False)
    data = mujoco.MjData(model)
    num_envs, groups = 4, (0,)
    sim = Simulation(num_envs, SimulationCfg(engine="native"), model=model, device="cpu")
    generator = torch.Generator().manual_seed(1)
    grid = torch.stack(torch.meshgrid(torch.arange(8.0), torch.arange(9.0), indexing="ij"), -1)
    grid = torch.cat((grid.flatten(0, 1) * 0.1 - 0.4, torch.full((72, 1), 0.9)), dim=-1)
    tilted = torch.nn.functional.normalize(torch.randn(72, 3, generator=generator), dim=-1)
    tilted[..., 2] = -3.0
    tilted = torch.nn.functional.normalize(tilted, dim=-1)
    reach = torch.full((72,), 1.5)
    used = 0
    for step in range(5):
        centre = torch.rand(num_envs, 1, 3, generator=generator) * 8 - 4
        centre[..., 2] = 0.0
        centre[0] += 30.0 * (step == 3)
        sim.data.qpos[:, :3] = centre[:, 0] + torch.tensor([0.02, 0.03, 0.8])
        origins = (grid + centre).contiguous()
        directions = torch.tensor(DOWN) if step < 3 else tilted
        directions = directions.expand(num_envs, 72, 3).contiguous()
        distances, normals, geoms = sim.raycast(origins, directions, groups, None, reach)
        used += sum(len(p.parts) > 0 for p in sim._engine._rays._plans.values())
        for env in range(num_envs):
            data.qpos[:3] = sim.data.qpos[env, :3].numpy()
            mujoco.mj_kinematics(model, data)
            for r in range(0, 72, 7):
                expected, normal = mj_ray(
                    model, data, origins[env, r].numpy(), directions[env, r].numpy(), groups, -1
                )
                miss = expected > 1.5 or expected < 0
                assert distances[env, r].item() == pytest.approx(-1 if miss else expected, abs=1e-6)
                assert (geoms[env, r] < 0).item() == miss
                if not miss:
                    np.testing.assert_allclose(normals[env, r], normal, atol=1e-6)
    # All looked only at what is near, but the first and the one in which the rays were tilted.
    assert used == 3


@settings(max_examples=20, deadline=None)
@given(
    x=st.floats(-5, 8), y=st.floats(-4, 4), z=st.floats(-0.3, 1.2), tilt=st.floats(-0.5, 0.5),
    spread=st.sampled_from([0.02, 0.3, 2.0]),
)  # fmt: skip
def test_what_is_near_does_not_change_hills_wherever_the_rays_are(hilly, x, y, z, tilt, spread):
    sim, everything = hilly
    grid = torch.linspace(-1, 1, 40)[:, None] * torch.tensor([1.0, 0.7, 0.0]) * spread
    origins = (grid + torch.tensor([x, y, z])).repeat(2, 1, 1)
    origins[1] += 0.3
    direction = torch.nn.functional.normalize(torch.tensor([tilt, 0.1 * tilt, -1.0]), dim=0)
    directions = direction.expand(2, 40, 3).contiguous()
    reach = torch.full((40,), 2.0)
    every = everything.raycast(origins, directions, None, None, reach)
    # The first call may find rays outside of the windows made before, the second does not.
    for _ in range(2):
        near = sim.raycast(origins, directions, None, None, reach)
        for a, b in zip(near, every, strict=True):
            torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
    assert all(p.parts for p in sim._engine._rays._plans.values())


def test_the_same_rays_may_reach_farther_than_the_last_time(hilly):
    sim, everything = hilly
    origins = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(5)) * 2.0
    slanted = torch.nn.functional.normalize(torch.tensor([0.9, 0.4, -0.5]), dim=0)
    directions = slanted.expand(2, 40, 3).contiguous()
    for reach in (0.2, 0.2, 3.0, 3.0):
        rays = (origins, directions, None, None, torch.full((40,), reach))
        for near, every in zip(sim.raycast(*rays), everything.raycast(*rays), strict=True):
            torch.testing.assert_close(near, every, atol=1e-6, rtol=0)


def test_rays_are_cast_under_inference_mode_as_a_rollout_does(hilly):
    sim, everything = hilly
    with torch.inference_mode():
        directions = torch.tensor(DOWN).repeat(2, 40, 1)
        for height in (1.0, 2.0):
            origins = torch.rand(2, 40, 3) * height
            rays = (origins, directions, None, None, torch.full((40,), 3.0))
            for near, every in zip(sim.raycast(*rays), everything.raycast(*rays), strict=True):
                torch.testing.assert_close(near, every, atol=1e-6, rtol=0)


@pytest.fixture(scope="module")
def hilly():
    """A simulation that looks at what is near, and one that looks at everything."""
    model = terrain_model(turned=False, moving=True, hills=True)
    sims = [
        Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu") for _ in range(2)
    ]
    # Geoms that are not as compiled are not sought by place. This one is turned as it was.
    sims[1].expand_model_fields(("geom_quat",))
    sims[1].model.geom_quat[:, 1] *= -1.0
    points = torch.zeros(2, 40, 3)
    points[..., 2] = 2.0
    for _ in range(2):
        sims[0].raycast(points, torch.tensor(DOWN).repeat(2, 40, 1), None, None, torch.ones(40))
    return sims


def test_what_is_near_is_met_as_everything_is_to_the_bit():
    model = terrain_model(turned=True, moving=True, hills=True, meshes=True)
    sim = Simulation(64, SimulationCfg(engine="native"), model=model, device="cpu")
    generator = torch.Generator().manual_seed(3)
    places = torch.rand(64, 1, 3, generator=generator) * torch.tensor([12.0, 8.0, 1.0])
    spots = 0.3 * torch.rand(30, 3, generator=generator) - torch.tensor([4.0, 4.0, 0.2])
    origins = places + spots
    directions = torch.randn(30, 3, generator=generator) * torch.tensor([0.2, 0.2, 1.0])
    directions = torch.nn.functional.normalize(directions, dim=-1).repeat(64, 1, 1)
    reach = torch.full((30,), 1.5)
    # The first call looks at everything, the second at what is near.
    everything, near = [sim.raycast(origins, directions, None, None, reach) for _ in range(2)]
    assert all(plan.parts for plan in sim._engine._rays._plans.values())
    met = model.geom_type[everything[2][everything[0] >= 0].numpy()]
    kinds = {"PLANE", "HFIELD", "CYLINDER", "BOX", "MESH"}
    assert {mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_") for kind in met} >= kinds
    for a, b in zip(everything, near, strict=True):
        assert torch.equal(a, b)


PLANES = """
<mujoco><worldbody>
  <geom name="ground" type="plane" size="0 0 1" pos="0 0 -.3"/>
  <geom name="table" type="plane" size="1.5 0 .1" pos=".2 .1 .4" euler="10 -20 30"/>
  <geom name="shelf" type="plane" size=".5 .8 .1" pos="0 0 1.1"/>
  <geom name="lamp" type="sphere" size=".5" pos="0 0 1.5" group="1"/>
  <body name="ball" pos="0 0 3"><freejoint/><geom size=".1" group="3"/></body>
  <body name="lift" mocap="true"><geom type="plane" size="1 1 .1" group="2"/></body>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def planes():
    model = mujoco.MjModel.from_xml_string(PLANES)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu"), data


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), slant=st.sampled_from([0.0, 0.5, 3.0]))
def test_rays_against_nothing_but_planes_are_those_of_mj_ray(planes, seed, slant):
    sim, data = planes
    generator = torch.Generator().manual_seed(seed)
    origins = 4.0 * torch.rand(2, 12, 3, generator=generator) - 2.0
    directions = slant * torch.randn(2, 12, 3, generator=generator)
    directions[..., 2] -= 1.0
    directions /= directions.norm(dim=-1, keepdim=True)
    origins[1, 0, 0] = torch.nan
    distances, normals, geoms = sim.raycast(origins, directions, (0,))
    # A ray of an environment that has diverged meets nothing.
    assert distances[1, 0] == -1
    assert geoms[1, 0] == -1
    for env, r in origins.isfinite().all(dim=-1).nonzero().tolist():
        distance, normal, geom = mj_ray_hit(
            sim.mj_model, data, origins[env, r].numpy(), directions[env, r].numpy(), (0,)
        )
        assert distances[env, r].item() == pytest.approx(distance, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(normals[env, r], normal, atol=1e-7)
        assert geoms[env, r] == geom


@pytest.mark.parametrize(
    ("groups", "excluded", "is_alone"),
    [((0,), -1, True), ((0,), 1, True), ((0,), 0, False), ((0, 1), -1, False), ((2,), -1, False)],
)
def test_only_rays_that_meet_fixed_planes_alone_are_computed_without_a_query(
    planes, groups, excluded, is_alone
):
    sim, _ = planes
    origins, directions = rays(((0.0, 0.0, 2.5), DOWN))
    for _ in range(2):
        sim.raycast(origins, directions, groups, torch.tensor([excluded], dtype=torch.int32))
    plan = list(sim._engine._rays._plans.values())[-1]
    assert (plan.planes is not None) == is_alone


def test_planes_that_a_randomization_has_moved_are_met_where_they_are():
    model = mujoco.MjModel.from_xml_string(PLANES)
    sim = Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu")
    origins, directions = rays(((0.0, 0.0, 2.0), DOWN))
    sim.raycast(origins, directions, (0,))
    sim.expand_model_fields(("geom_pos",))
    sim.model.geom_pos[1, model.geom("shelf").id, 2] = 1.6
    distances = sim.raycast(origins, directions, (0,))[0]
    assert distances.flatten().tolist() == pytest.approx([0.9, 0.4])


def test_geoms_that_a_randomization_has_moved_are_met_where_they_are():
    model = terrain_model(turned=False, moving=False, hills=False)
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 2.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    before = [sim.raycast(origins, directions)[0] for _ in range(3)][-1]
    sim.expand_model_fields(("geom_pos",))
    sim.model.geom_pos[1, :, 2] += 0.1
    after = sim.raycast(origins, directions)[0]
    moved = torch.tensor([0.0, -0.1, 0.0])[:, None]
    torch.testing.assert_close(after, before + moved, atol=1e-5, rtol=0)


def queries_of_everything(sim: Simulation, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list that grows whenever all geoms are tried, static ones included."""
    calls: list[bool] = []
    rays_of = sim._engine._rays
    original = rays_of._cast_all

    def spy(*args, static: bool = True, **kwargs):
        if static:
            calls.append(True)
        return original(*args, static=static, **kwargs)

    monkeypatch.setattr(rays_of, "_cast_all", spy)
    return calls


def test_randomizing_what_moves_leaves_the_ground_looked_up_by_place(monkeypatch, caplog):
    model = terrain_model(turned=False, moving=True, hills=False)
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    sim.raycast(origins, directions)
    calls = queries_of_everything(sim, monkeypatch)
    fields = ("geom_size", "geom_pos", "geom_rgba", "geom_friction", "body_pos", "geom_solref")
    sim.expand_model_fields(fields)
    ball = model.ngeom - 1
    sim.model.geom_size[1, ball] = 0.3
    sim.model.geom_pos[2, ball, 0] = 0.5
    sim.model.geom_rgba[:, :, 0] = 0.1
    sim.model.geom_rgba[0, ball, 3] = 0.0
    sim.model.geom_friction[:] = 0.3
    # Colours that differ make it a query of another kind, whose first call looks at everything.
    everything = sim.raycast(origins, directions)
    calls.clear()
    near = sim.raycast(origins, directions)
    assert calls == []
    assert all(torch.equal(a, b) for a, b in zip(everything, near, strict=True))
    distances, _, geoms = near
    assert caplog.text == ""
    # The first is transparent, the second large, and the third stands aside.
    assert geoms[:, 0].eq(ball).tolist() == [False, True, False]
    assert distances[1, 0] == pytest.approx(1.7)


def test_a_ground_that_differs_is_found_by_trying_everything_and_said_once(monkeypatch, caplog):
    model = terrain_model(turned=False, moving=True, hills=False)
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    before = [sim.raycast(origins, directions)[0] for _ in range(2)][-1]
    calls = queries_of_everything(sim, monkeypatch)
    sim.raycast(origins, directions)
    assert calls == []
    sim.expand_model_fields(("geom_pos",))
    sim.model.geom_pos[1, : model.ngeom - 1, 2] -= 0.1
    with caplog.at_level("WARNING"):
        after = [sim.raycast(origins, directions)[0] for _ in range(2)][-1]
    assert len(calls) == 2
    assert len(caplog.records) == 1
    assert "'geom_pos' of geoms that never move" in caplog.text
    torch.testing.assert_close(after[[0, 2]], before[[0, 2]])
    # As it was compiled again.
    sim.model.geom_pos.copy_(sim.get_default_field("geom_pos"))
    sim.raycast(origins, directions)
    assert len(calls) == 2
