"""Ground from meshes and height maps, on both engines."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.scene import Scene, SceneCfg
from mjlab.sim.config import MujocoCfg, SimulationCfg
from mjlab.sim.simulation import Simulation
from mjlab.terrains import TerrainEntity, TerrainEntityCfg, TerrainFileCfg

RADIUS = 0.2
ENGINES = ["native", "warp"]


def build(kind, path, num_envs=1, env_spacing=2.0, **fields):
    cfg = TerrainEntityCfg(
        terrain_type=kind,
        terrain_file=TerrainFileCfg(path=str(path), **fields),
        num_envs=num_envs,
        env_spacing=env_spacing,
    )
    return TerrainEntity(cfg, "cpu")


def hill(x, y):
    """Height (m), linear between the lines x = 0 and y = 0."""
    return 0.5 - 0.1 * np.abs(x) + 0.2 * np.abs(y)


@pytest.fixture
def array(tmp_path):
    """The hill over 8 x 6 m, pixels of 0.1 m, heights in cm."""
    x, y = np.linspace(-4, 4, 81), np.linspace(-3, 3, 61)
    np.save(tmp_path / "hill.npy", 100 * hill(x[None, :], y[:, None]))
    return tmp_path / "hill.npy"


@pytest.fixture
def mesh(tmp_path):
    """The hill over 8 x 6 m as eight triangles, in mm."""
    xs, ys = (-4, 0, 4), (-3, 0, 3)
    lines = [f"v {1e3 * x} {1e3 * y} {1e3 * hill(x, y):.6f}" for y in ys for x in xs]
    for row in range(2):
        for col in range(2):
            a = 3 * row + col + 1
            lines += [f"f {a} {a + 1} {a + 4}", f"f {a} {a + 4} {a + 3}"]
    (tmp_path / "hill.obj").write_text("\n".join(lines))
    return tmp_path / "hill.obj"


def heights(entity, points, engine="native"):
    """Measure heights (m) by rays from above."""
    cfg = SimulationCfg(engine=engine, mujoco=MujocoCfg(), num_threads=1)
    sim = Simulation(1, cfg, model=entity.compile(), device="cpu")
    sim.forward()
    origins = torch.tensor([(x, y, 10.0) for x, y in points], dtype=torch.float32)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(1, len(points), 3).contiguous()
    return 10.0 - sim.raycast(origins[None], down)[0][0].numpy()


POINTS = np.random.default_rng(0).uniform((-3.9, -2.9), (3.9, 2.9), size=(40, 2))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("kind", "scale"), [("heightmap", 0.01), ("mesh", 0.001)])
def test_rays_measure_the_known_surface(kind, scale, engine, array, mesh):
    path = array if kind == "heightmap" else mesh
    entity = build(kind, path, scale=scale, pos=(1.0, -2.0, 0.3))
    expected = [0.3 + hill(x, y) for x, y in POINTS]
    np.testing.assert_allclose(heights(entity, POINTS + (1.0, -2.0), engine), expected, atol=3e-4)
    np.testing.assert_allclose(entity.bounds, [(-3.0, -5.0), (5.0, 1.0)], atol=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_ball_lies_in_the_hollow_of_a_mesh(engine, tmp_path):
    """MuJoCo would collide the mesh as its convex hull, which has no hollow."""
    xs, ys = (-2, -1, 1, 2), (-2, 2)
    lines = [f"v {x} {y} {1.0 * (abs(x) == 2)}" for y in ys for x in xs]
    lines += [f"f {a} {a + 1} {a + 5}\nf {a} {a + 5} {a + 4}" for a in (1, 2, 3)]
    (tmp_path / "hollow.obj").write_text("\n".join(lines))
    entity = build("mesh", tmp_path / "hollow.obj", resolution=0.1)
    spec = entity.spec
    ball = spec.worldbody.add_body(name="ball", pos=(0.3, 0.3, 0.5))
    ball.add_joint(name="fall", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1), damping=5.0)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(RADIUS, 0, 0), mass=1.0)
    cfg = SimulationCfg(
        engine=engine, mujoco=MujocoCfg(timestep=0.004), num_threads=1, nconmax=30, njmax=120
    )
    sim = Simulation(1, cfg, spec=spec, device="cpu")
    sim.step(nstep=300)
    assert 0.5 + sim.data.qpos[0, 0].item() == pytest.approx(RADIUS, abs=0.005)


@pytest.mark.parametrize("bits", [8, 16])
def test_white_of_a_picture_is_high_and_up_is_y(bits, tmp_path):
    from PIL import Image

    picture = np.zeros((3, 4), np.uint8 if bits == 8 else np.uint16)
    picture[0, 3] = 2**bits - 1  # Upper right.
    Image.fromarray(picture).save(tmp_path / "map.png")
    entity = build("heightmap", tmp_path / "map.png", scale=0.6, resolution=1.0)
    corners = [(1.499, 0.999), (1.499, -0.999), (-1.499, 0.999)]
    np.testing.assert_allclose(heights(entity, corners), [0.6, 0.0, 0.0], atol=2e-3)


def test_gray_of_a_color_picture_ignores_alpha(tmp_path):
    from PIL import Image

    picture = np.zeros((2, 2, 4), np.uint8)
    picture[..., :3], picture[..., 3] = (255, 0, 0), 255
    Image.fromarray(picture).save(tmp_path / "map.png")
    entity = build("heightmap", tmp_path / "map.png", scale=0.3, resolution=1.0)
    assert heights(entity, [(0.0, 0.0)])[0] == pytest.approx(0.1, abs=1e-3)


def test_holes_take_the_lowest_height(tmp_path):
    field = np.full((5, 5), 1.0)
    field[1, 1], field[4, 4] = np.nan, -0.5
    np.save(tmp_path / "map.npy", field)
    entity = build("heightmap", tmp_path / "map.npy", resolution=1.0)
    assert heights(entity, [(-1.0, -1.0)])[0] == pytest.approx(-0.5, abs=1e-4)


def test_environments_stand_on_a_grid_over_the_ground(array):
    entity = build("heightmap", array, num_envs=12, env_spacing=2.0, scale=0.01)
    places = {(x, y) for x, y, _ in entity.env_origins.tolist()}
    assert places == {(x, y) for x in (-2.0, 0.0, 2.0) for y in (-1.0, 1.0)}
    for x, y, z in entity.env_origins.tolist():
        # The highest ground within 1 m of this hill.
        angles = np.linspace(0, 2 * np.pi, 721)
        around = hill(x + np.cos(angles), y + np.sin(angles)).max()
        assert hill(x, y) < z <= around + 1e-6
        assert z == pytest.approx(around, abs=0.02)


def test_environments_stand_at_chosen_places(array):
    origins = ((1.0, 0.5), (-2.0, 1.0))
    entity = build("heightmap", array, num_envs=4, origins=origins, scale=0.01)
    expected = [origins[0], origins[0], origins[1], origins[1]]
    np.testing.assert_allclose(entity.env_origins[:, :2], expected)
    torch.manual_seed(0)
    entity.randomize_env_origins(torch.arange(4))
    assert {tuple(p) for p in entity.env_origins[:, :2].tolist()} <= set(origins)


def test_a_scene_holds_the_ground(mesh):
    terrain = TerrainEntityCfg(
        terrain_type="mesh", terrain_file=TerrainFileCfg(path=str(mesh), scale=0.001)
    )
    scene = Scene(SceneCfg(num_envs=3, env_spacing=1.5, terrain=terrain), device="cpu")
    model = scene.compile()
    geom = model.geom("terrain")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_HFIELD
    assert model.body(geom.bodyid[0]).name == "terrain"
    assert geom.group[0] == 0
    assert scene.env_origins.shape == (3, 3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.tif", None, r"path: .*\.png or \.npy.*map.tif"),
        ("map.npy", np.zeros(5), r"path: .*shape \(5,\)"),
        ("map.npy", np.full((3, 3), np.nan), "path: .*finite"),
    ],
)
def test_files_without_heights_are_named(name, content, message, tmp_path):
    if content is not None:
        np.save(tmp_path / name, content)
    with pytest.raises(ValueError, match=message):
        build("heightmap", tmp_path / name)


def test_a_type_without_its_file_is_named():
    with pytest.raises(ValueError, match="terrain_file: .*'mesh'.*TerrainFileCfg"):
        TerrainEntity(TerrainEntityCfg(terrain_type="mesh"), "cpu")
