"""Heights above the ground: reductions, and what a ray that meets nothing means."""

from __future__ import annotations

import math

import mujoco
import pytest
import torch

from mjlab.sensor import ObjRef, RingPatternCfg, TerrainHeightSensorCfg
from mjlab.sensor.terrain_height_sensor import OneSidedGround

from .ray_scenes import BASE, ROBOT, field_of, floor, scene_with, sense

ENGINES = ("native", "warp")
# Elevations 0.2 to 1 (of 1 m), rising along x.
RAMP = [[0.0, 0.25, 0.5, 0.75, 1.0]] * 3


def height(name="height", **kwargs) -> TerrainHeightSensorCfg:
    defaults = {
        "frame": BASE,
        "pattern": RingPatternCfg.single_ring(0.1, 4),
        "ray_alignment": "yaw",
        "max_distance": 2.0,
        "include_geom_groups": (0,),
    }
    return TerrainHeightSensorCfg(name=name, **{**defaults, **kwargs})


def floor_at(z: float, **kwargs):
    def edit(spec: mujoco.MjSpec) -> None:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(type=plane, size=[0, 0, 1], pos=[0, 0, z], **kwargs)

    return edit


def put(sim, *positions) -> None:
    sim.data.qpos[:, :3] = torch.tensor(positions)


@pytest.mark.parametrize("engine", ENGINES)
def test_heights_are_reduced_over_the_rays_of_each_frame(engine):
    def step(spec: mujoco.MjSpec) -> None:
        floor(spec)
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(name="step", type=box, size=[1, 1, 0.2], pos=[1.05, 0, 0.1])

    frames = (BASE, ObjRef("site", "left", "robot"))
    cfgs = [height(r, reduction=r, frame=frames) for r in ("min", "max", "mean", "none")]
    sim, scene = scene_with(*cfgs, ground=step, engine=engine, num_envs=2)
    put(sim, [0.0, 0.0, 1.0], [-3.0, 0.0, 1.5])
    sense(sim)
    data = {r: scene[r].data.heights for r in ("min", "max", "mean", "none")}
    # One of five rays, the first of the ring, is above the step: 0.7 instead of 1.
    rays = torch.tensor([[1.0, 0.7, 1.0, 1.0, 1.0]] * 2)
    torch.testing.assert_close(data["none"], torch.stack((rays, torch.full((2, 5), 1.5))))
    torch.testing.assert_close(data["min"], torch.tensor([[0.7, 0.7], [1.5, 1.5]]))
    torch.testing.assert_close(data["max"], torch.tensor([[1.0, 1.0], [1.5, 1.5]]))
    torch.testing.assert_close(data["mean"], torch.tensor([[0.94, 0.94], [1.5, 1.5]]))


@pytest.mark.parametrize("ground_z", [-3.0, 0.0, 5.0])
@pytest.mark.parametrize("engine", ENGINES)
def test_ground_out_of_reach_is_max_distance_away_wherever_the_ground_is(engine, ground_z):
    sim, scene = scene_with(height(), ground=floor_at(ground_z), engine=engine, num_envs=2)
    put(sim, [0, 0, ground_z + 2.5], [0, 0, ground_z + 0.5])
    sense(sim)
    torch.testing.assert_close(scene["height"].data.heights, torch.tensor([[2.0], [0.5]]))


@pytest.mark.parametrize("engine", ENGINES)
def test_below_a_plane_and_below_a_height_field_the_height_is_zero(engine):
    sim, scene = scene_with(
        height(reduction="none"), ground=field_of(RAMP), num_envs=5, engine=engine
    )
    put(
        sim,
        # At x = 1 the ramp is 0.75 high.
        *([1.0, 0.0, 1.0], [1.0, 0.0, 0.5], [1.0, 0.0, -0.2]),
        # Below its base, and beyond its edge.
        *([1.0, 0.0, -3.0], [9.0, 0.0, 0.5]),
    )
    sense(sim)
    ring = torch.tensor([0.0, 0.1, 0.0, -0.1, 0.0])
    expected = torch.stack(
        (0.25 - 0.25 * ring, torch.zeros(5), torch.zeros(5), torch.zeros(5), torch.full((5,), 2.0))
    )
    torch.testing.assert_close(scene["height"].data.heights[:, 0], expected, atol=1e-5, rtol=0)
    under, scene = scene_with(height(), engine=engine)
    put(under, [0.0, 0.0, -0.01])
    sense(under)
    assert scene["height"].data.heights.item() == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_rays_below_uphill_surfaces_are_zero(engine):
    # A foot 5 mm above a 1 : 2 slope: the uphill ray starts 45 mm below the surface.
    cfg = height(reduction="none", pattern=RingPatternCfg.single_ring(0.1, 2))
    steep = field_of([[0.0, 1.0], [0.0, 1.0]], size=(1.0, 1.0, 1.0, 0.5))
    sim, scene = scene_with(cfg, ground=steep, engine=engine)
    put(sim, [0.0, 0.0, 0.505])
    sense(sim)
    torch.testing.assert_close(
        scene["height"].data.heights[0, 0], torch.tensor([0.005, 0.0, 0.055]), atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_inside_a_solid_the_height_is_zero(engine):
    def block(spec: mujoco.MjSpec) -> None:
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(name="block", type=box, size=[1, 1, 0.2], pos=[0, 0, 0.2])

    sim, scene = scene_with(height(), ground=block, engine=engine)
    put(sim, [0.0, 0.0, 0.3])
    sense(sim)
    assert scene["height"].data.heights.item() == 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_a_turned_or_finite_ground_covers_what_it_covers_and_no_more(engine):
    def ramp(spec: mujoco.MjSpec) -> None:
        half = math.pi / 8
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(
            name="ramp", type=plane, size=[1, 1, 1], quat=[math.cos(half), 0, -math.sin(half), 0]
        )

    sim, scene = scene_with(
        height(pattern=RingPatternCfg(())), ground=ramp, num_envs=3, engine=engine
    )
    # The plane rises along x at 45 degrees, and ends at |x| = 0.71 and |y| = 1.
    put(sim, [0.5, 0.0, 0.6], [0.5, 0.0, 0.4], [0.5, 1.1, 0.4])
    sense(sim)
    torch.testing.assert_close(
        scene["height"].data.heights[:, 0], torch.tensor([0.1, 0.0, 2.0]), atol=1e-5, rtol=0
    )


def test_ground_of_another_group_is_no_ground():
    sim, scene = scene_with(height(), ground=floor_at(0.0, group=4))
    put(sim, [0.0, 0.0, -1.0])
    sense(sim)
    assert scene["height"].data.heights.item() == 2.0


@pytest.mark.parametrize("engine", ENGINES)
def test_ground_may_differ_by_environment(engine):
    slab = """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 .1"
      elevation="0 0 1 1"/></asset><worldbody><body name="slab"><geom type="hfield" hfield="h"/>
      </body></worldbody></mujoco>"""
    sim, scene = scene_with(
        height(pattern=RingPatternCfg(())),
        ground=lambda spec: None,
        num_envs=4,
        engine=engine,
        entities={"robot": ROBOT, "slab": slab},
    )
    positions = [[0.0, 0, 0], [0, 0, 2.0], [5.0, 0, 2.0], [0.0, 0, 0.8]]
    sim.data.mocap_pos[:, 0] = torch.tensor(positions)
    put(sim, *[[0.0, 0.0, 1.0]] * 4)
    sense(sim)
    # The field is 0.5 high here; in the last environment the robot is below its surface.
    torch.testing.assert_close(
        scene["height"].data.heights[:, 0], torch.tensor([0.5, 0.0, 2.0, 0.0]), atol=1e-5, rtol=0
    )
    assert (scene["height"].data.distances[1:] == -1.0).all()


def test_other_reductions_are_refused():
    with pytest.raises(ValueError, match="Ray sensor 'height' reduction.*'median'"):
        scene_with(height(reduction="median"))


def test_the_height_data_has_the_fields_of_the_ray_data_too():
    sim, scene = scene_with(height())
    sense(sim)
    data = scene["height"].data
    torch.testing.assert_close(data.distances, torch.ones(1, 5))
    assert data.frame_pos_w.shape == (1, 1, 3)


def test_points_below_patches():
    """A hundred patches, each at its own height and yaw, and a floor below them."""
    generator = torch.Generator().manual_seed(0)
    spec = mujoco.MjSpec()
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    heights = torch.rand(100, generator=generator)
    for i, z in enumerate(heights.tolist()):
        yaw = [1.0, 0.0, 0.0, 0.0] if i % 2 else [math.cos(0.2), 0.0, 0.0, math.sin(0.2)]
        pos = [float(i // 10), float(i % 10), z]
        spec.worldbody.add_geom(type=plane, size=[0.5, 0.5, 1], pos=pos, quat=yaw)
    spec.worldbody.add_geom(type=plane, size=[0, 0, 1], pos=[0, 0, -0.5])
    model = spec.compile()
    ground = OneSidedGround(model, None, None, "cpu")
    points = torch.rand(2000, 3, generator=generator) * torch.tensor([12.0, 12.0, 2.0])
    points -= torch.tensor([1.5, 1.5, 1.0])
    points[0] = torch.nan
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    local = points[:, None] - torch.as_tensor(data.geom_xpos).float()
    frames = torch.as_tensor(data.geom_xmat).float().view(-1, 3, 3)
    local = (frames * local[..., None]).sum(dim=-2)
    size = torch.as_tensor(model.geom_size[:, :2]).float()
    inside = ((local[..., :2].abs() <= size) | (size == 0)).all(dim=-1)
    expected = (inside & (local[..., 2] < 0)).any(dim=-1)
    assert 0.2 < expected.float().mean() < 0.8
    assert torch.equal(ground.is_above(points, torch.zeros(2000, dtype=torch.long)), expected)
