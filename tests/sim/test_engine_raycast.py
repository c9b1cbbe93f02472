"""Ray casting on both engines, and the ground table of the native engine."""

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
# Position along x, start height, direction; distance and z of the normal, or None for a miss.
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
    """Origin and direction of each ray in both environments."""
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


def test_rays_of_some_environments_meet_what_they_meet_among_all(shapes):
    origins, directions = rays(
        *[((x + 0.01, 0.02, z), direction) for x, z, direction, _, _ in CASES.values()],
        ((0.0, 50.0, 3.0), DOWN),
    )
    # The ball of the second environment is elsewhere.
    shapes.data.qpos[1, 2] = 1.0
    shapes.forward()
    everywhere = shapes.raycast(origins, directions)
    some = shapes.raycast(origins, directions, env_ids=torch.tensor([1]))
    shapes.data.qpos[1, 2] = 0.0
    shapes.forward()
    assert everywhere[0][0, -1] != everywhere[0][1, -1]
    for values, expected in zip(some, everywhere, strict=True):
        assert values.shape == expected.shape
        assert torch.equal(values[1], expected[1])


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


# Ground table.


def terrain_model(hills: bool = False, kind: str = "BOX", turn: float = 0.0) -> mujoco.MjModel:
    """Rows of blocks above a floor, a ball above, and optionally hills."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, -0.4])
    for i in range(12):
        for j in range(12):
            spec.worldbody.add_geom(
                type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"),
                size=[0.25, rng.uniform(0.2, 0.3), 0.3],
                pos=[0.5 * i - 3, 0.5 * j - 3, 0.2 * rng.random()],
                quat=[1, 0, 0, turn],
            )
    for k in range(2 * hills):
        heights = rng.random(400).astype(np.float32)
        spec.add_hfield(name=f"h{k}", nrow=20, ncol=20, size=[1, 1, 0.4, 0.15], userdata=heights)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=f"h{k}", pos=[4.0 + 2 * k, 0, 0]
        )
        # Protrudes from the ground in places, but not from the summit.
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.6, 0.5, 0.2], pos=[4.0 + 2 * k, 0, 0]
        )
    body = spec.worldbody.add_body(name="body", pos=[0, 0, 1])
    body.add_freejoint()
    body.add_geom(name="ball", size=[0.05, 0.05, 0.05], group=2)
    return spec.compile()


def mj_ray_hit(model, data, origin, direction, groups, exclude=-1) -> tuple[float, np.ndarray, int]:
    normal, geom = np.zeros(3), np.array([-1], dtype=np.int32)
    mask = None if groups is None else np.isin(np.arange(6), groups).astype(np.uint8)
    distance = mujoco.mj_ray(
        model, data, origin.astype(float), direction.astype(float), mask, 1, exclude, geom, normal
    )
    return distance, normal, int(geom[0])


def queries(sim: Simulation, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list that gets True per batch query of static geoms, False per other query."""
    calls: list[bool] = []
    original = sim._engine._batch.ray

    def spy(*args, flg_static: bool = True, **kwargs):
        calls.append(flg_static)
        return original(*args, flg_static=flg_static, **kwargs)

    monkeypatch.setattr(sim._engine._batch, "ray", spy)
    return calls


@pytest.mark.parametrize("groups", [(0,), None])
def test_rays_that_are_looked_up_are_those_of_mj_ray(groups, monkeypatch):
    model = terrain_model()
    data = mujoco.MjData(model)
    sim = Simulation(4, SimulationCfg(engine="native"), model=model, device="cpu")
    calls = queries(sim, monkeypatch)
    generator = torch.Generator().manual_seed(1)
    # From above, from within the blocks and from below; above the blocks and beside them.
    low, high = torch.tensor([-4.0, -4.0, -0.6]), torch.tensor([4.0, 4.0, 1.2])
    origins = low + torch.rand(4, 200, 3, generator=generator) * (high - low)
    origins[0] += torch.tensor([30.0, 0.0, 0.0])
    sim.data.qpos[:, :3] = origins[:, 0] - torch.tensor([0.01, 0.02, 0.3])
    directions = torch.tensor(DOWN).repeat(4, 200, 1)
    distances, normals, geoms = sim.raycast(origins, directions, groups)
    assert calls == ([] if groups else [False])
    kinds = set()
    for env in range(4):
        data.qpos[:] = sim.data.qpos[env]
        mujoco.mj_kinematics(model, data)
        for r in range(200):
            ray = origins[env, r].numpy(), directions[env, r].numpy()
            distance, normal, geom = mj_ray_hit(model, data, *ray, groups)
            assert distances[env, r].item() == pytest.approx(distance, rel=1e-6, abs=1e-6)
            assert geoms[env, r].item() == geom
            np.testing.assert_allclose(normals[env, r], normal, atol=1e-7)
            kinds.add((int(model.geom_type[geom]) if geom >= 0 else None, float(normal[2])))
    assert {(mujoco.mjtGeom.mjGEOM_BOX, -1.0), (mujoco.mjtGeom.mjGEOM_PLANE, 1.0)} < kinds
    assert (None, 0.0) in kinds


@pytest.fixture(scope="module")
def hilly():
    """Simulation with a ground table, and simulation that tests every geom."""
    model = terrain_model(hills=True)
    sims = [
        Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu") for _ in range(2)
    ]
    # The negated quaternion differs from the compiled one, which disables the table, but not the pose.
    sims[1].expand_model_fields(("geom_quat",))
    sims[1].model.geom_quat[:, 1] *= -1.0
    return sims


@settings(max_examples=20, deadline=None)
@given(
    x=st.floats(-5, 8), y=st.floats(-4, 4), z=st.floats(-0.3, 1.2),
    spread=st.sampled_from([0.02, 0.3, 2.0]),
)  # fmt: skip
def test_hills_are_looked_up_as_they_are_met_wherever_the_rays_are(hilly, x, y, z, spread):
    sim, everything = hilly
    grid = torch.linspace(-1, 1, 40)[:, None] * torch.tensor([1.0, 0.7, 0.0]) * spread
    origins = (grid + torch.tensor([x, y, z])).repeat(2, 1, 1)
    origins[1] += 0.3
    rays = origins, torch.tensor(DOWN).repeat(2, 40, 1), None, None, torch.full((40,), 2.0)
    with pytest.MonkeyPatch.context() as patch:
        calls = queries(sim, patch), queries(everything, patch)
        for a, b in zip(sim.raycast(*rays), everything.raycast(*rays), strict=True):
            torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
    assert True not in calls[0]
    assert True in calls[1]


def test_what_stands_out_of_a_height_field_is_met_first(hilly):
    sim, everything = hilly
    grid = torch.linspace(-0.983, 0.971, 60)
    places = torch.stack(
        torch.meshgrid(grid + 4.0, grid + 0.0123, torch.ones(1), indexing="ij"), -1
    )
    origins = places.reshape(1, -1, 3).repeat(2, 1, 1)
    directions = torch.tensor(DOWN).expand_as(origins).contiguous()
    near, every = (s.raycast(origins, directions) for s in hilly)
    kinds = sim.mj_model.geom_type[near[2]].flatten().tolist()
    assert set(kinds) == {int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_HFIELD)}
    assert torch.equal(near[2], every[2])
    torch.testing.assert_close(near[0], every[0], atol=1e-6, rtol=0)
    torch.testing.assert_close(near[1], every[1], atol=1e-6, rtol=0)


def test_rays_are_cast_under_inference_mode_as_a_rollout_does(hilly):
    sim, everything = hilly
    with torch.inference_mode():
        directions = torch.tensor(DOWN).repeat(2, 40, 1)
        for height in (1.0, 2.0):
            origins = torch.rand(2, 40, 3) * height
            rays = (origins, directions, None, None, torch.full((40,), 3.0))
            for near, every in zip(sim.raycast(*rays), everything.raycast(*rays), strict=True):
                torch.testing.assert_close(near, every, atol=1e-6, rtol=0)


def test_a_query_that_fails_in_one_environment_is_a_miss_there_alone(shapes):
    if shapes.capabilities.name != "native":
        pytest.skip("MuJoCo Warp does not raise")
    origins, directions = rays(((10.0, 0.0, 3.0), DOWN), ((60.0, 0.0, 0.5), DOWN))
    expected = [values[1].clone() for values in shapes.raycast(origins, directions)]
    # MuJoCo raises for a direction without a length.
    directions[0, 1] = 0.0
    distances, normals, geoms = shapes.raycast(origins, directions)
    assert distances[0].tolist() == geoms[0].tolist() == [-1, -1]
    assert (normals[0] == 0).all()
    for values, others in zip((distances, normals, geoms), expected, strict=True):
        assert torch.equal(values[1], others)


def test_an_environment_that_has_diverged_does_not_touch_the_others():
    sim = Simulation(
        3, SimulationCfg(engine="native"), model=terrain_model(hills=True), device="cpu"
    )
    origins = torch.rand(3, 20, 3) * torch.tensor([6.0, 1.0, 1.0]) + torch.tensor([0.0, 0.0, 0.5])
    directions = torch.tensor(DOWN).repeat(3, 20, 1)
    expected = [values.clone() for values in sim.raycast(origins, directions)]
    for bad in (torch.nan, torch.inf, -torch.inf):
        sim.data.qpos[1, :3] = bad
        diverged = origins.clone()
        diverged[1] = bad
        distances, normals, geoms = sim.raycast(diverged, directions)
        assert (distances[1] == -1).all()
        assert (geoms[1] == -1).all()
        for values, before in zip((distances, normals, geoms), expected, strict=True):
            assert torch.equal(values[[0, 2]], before[[0, 2]])


PLANES = """
<mujoco><worldbody>
  <geom name="ground" type="plane" size="0 0 1" pos="0 0 -.3"/>
  <geom name="table" type="plane" size="1.5 0 .1" pos=".2 .1 .4" group="4" euler="10 -20 30"/>
  <geom name="bench" type="plane" size="1.5 0 .1" pos=".2 .1 .4"/>
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
    # Rays of a diverged environment are misses.
    assert distances[1, 0] == -1
    assert geoms[1, 0] == -1
    for env, r in origins.isfinite().all(dim=-1).nonzero().tolist():
        distance, normal, geom = mj_ray_hit(
            sim.mj_model, data, origins[env, r].numpy(), directions[env, r].numpy(), (0,)
        )
        assert distances[env, r].item() == pytest.approx(distance, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(normals[env, r], normal, atol=1e-7)
        assert geoms[env, r] == geom


def test_rays_on_an_endless_plane():
    xml = """
    <mujoco><worldbody>
      <geom type="sphere" size="1" group="1"/>
      <geom type="plane" size="0 0 1" pos="7 -8 -.25"/>
    </worldbody></mujoco>
    """
    model = mujoco.MjModel.from_xml_string(xml)
    sim = Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu")
    starts = ((3.0, 4.0, 1.5), (-1e4, 9.0, -0.25), (0.0, 0.0, -0.5), (0.0, 0.0, torch.nan))
    origins, directions = rays(*((start, DOWN) for start in starts))
    distances, normals, geoms = sim.raycast(origins, directions, (0,), None, torch.full((4,), 5.0))
    assert distances.tolist() == [[1.75, 0.0, -1.0, -1.0]] * 2
    assert normals.tolist() == [[[0.0, 0.0, 1.0]] * 2 + [[0.0, 0.0, 0.0]] * 2] * 2
    assert geoms.tolist() == [[1, 1, -1, -1]] * 2


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
    model = terrain_model()
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 2.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    before = [sim.raycast(origins, directions)[0] for _ in range(3)][-1]
    sim.expand_model_fields(("geom_pos",))
    sim.model.geom_pos[1, :, 2] += 0.1
    after = sim.raycast(origins, directions)[0]
    moved = torch.tensor([0.0, -0.1, 0.0])[:, None]
    torch.testing.assert_close(after, before + moved, atol=1e-5, rtol=0)


def test_randomizing_what_moves_leaves_the_ground_looked_up(monkeypatch, caplog):
    model = terrain_model()
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    sim.raycast(origins, directions)
    calls = queries(sim, monkeypatch)
    fields = ("geom_size", "geom_pos", "geom_rgba", "geom_friction", "body_pos", "geom_solref")
    sim.expand_model_fields(fields)
    ball = model.ngeom - 1
    sim.model.geom_size[1, ball] = 0.3
    sim.model.geom_pos[2, ball, 0] = 0.5
    sim.model.geom_rgba[:, :, 0] = 0.1
    sim.model.geom_rgba[0, ball, 3] = 0.0
    sim.model.geom_friction[:] = 0.3
    distances, _, geoms = sim.raycast(origins, directions)
    assert calls == [False]
    assert caplog.text == ""
    # The first is transparent, the second large, and the third stands aside.
    assert geoms[:, 0].eq(ball).tolist() == [False, True, False]
    assert distances[1, 0] == pytest.approx(1.7)


def test_a_ground_that_differs_is_found_by_trying_everything_and_said_once(monkeypatch, caplog):
    model = terrain_model()
    sim = Simulation(3, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([0.0, 0.0, 3.0]).repeat(3, 4, 1)
    directions = torch.tensor(DOWN).repeat(3, 4, 1)
    before = [sim.raycast(origins, directions)[0] for _ in range(2)][-1]
    calls = queries(sim, monkeypatch)
    sim.expand_model_fields(("geom_pos",))
    sim.model.geom_pos[1, : model.ngeom - 1, 2] -= 0.1
    with caplog.at_level("WARNING"):
        after = [sim.raycast(origins, directions)[0] for _ in range(2)][-1]
    assert calls == [True, True]
    assert len(caplog.records) == 1
    assert "'geom_pos'" in caplog.text
    torch.testing.assert_close(after[[0, 2]], before[[0, 2]])
    # Restore the compiled values.
    sim.model.geom_pos.copy_(sim.get_default_field("geom_pos"))
    sim.raycast(origins, directions)
    assert calls == [True, True, False]


@pytest.mark.parametrize("compiled", [0.0, 1.0])
def test_a_block_is_met_where_it_is_visible(compiled):
    """A geom is hit in environments that make it opaque, whether compiled transparent or not."""
    model = terrain_model()
    block = 1
    model.geom_rgba[block, 3] = compiled
    sim = Simulation(2, SimulationCfg(engine="native"), model=model, device="cpu")
    origins = torch.tensor([-3.0, -3.0, 3.0]).repeat(2, 1, 1)
    directions = torch.tensor(DOWN).repeat(2, 1, 1)
    sim.raycast(origins, directions)
    sim.expand_model_fields(("geom_rgba",))
    sim.model.geom_rgba[:, block, 3] = torch.tensor([0.0, 1.0])
    for _ in range(2):
        assert sim.raycast(origins, directions)[2].flatten().tolist() == [0, block]
