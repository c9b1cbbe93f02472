"""Terrain scans see the ground, and not the robot that carries them."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import mujoco
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.envs.mdp import height_scan
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import GridPatternCfg, ObjRef, RayCastSensorCfg, TerrainHeightSensorCfg
from mjlab.sim import SimulationCfg
from mjlab.utils.spec_config import GeomCfg

from .ray_scenes import BASE, ROBOT, floor, scene_with, sense
from .simulated import simulation_of

# Under the base: the foot, of group 2.
GRID = GridPatternCfg(size=(0.1, 0.1), resolution=0.05)


def scan(kind=RayCastSensorCfg, **kwargs):
    defaults = {"frame": BASE, "pattern": GRID, "ray_alignment": "yaw"}
    return kind(name="scan", **{**defaults, **kwargs})


def floor_with(**fields):
    def edit(spec: mujoco.MjSpec) -> None:
        floor(spec)
        for name, value in fields.items():
            setattr(spec.geom("floor"), name, value)

    return edit


def warnings_of(sim, scene) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # The second call does nothing.
        scene.check_terrain_scans(sim.mj_model)
        scene.check_terrain_scans(sim.mj_model)
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize("groups", [(0, 1, 2), None])
@pytest.mark.parametrize("kind", [RayCastSensorCfg, TerrainHeightSensorCfg])
@pytest.mark.parametrize("alignment", ["yaw", "world"])
def test_scan_of_its_own_robot_warns_once(kind, groups, alignment, engine):
    sensor = scan(kind, include_geom_groups=groups, ray_alignment=alignment)
    sim, scene = scene_with(sensor, engine=engine)
    (message,) = warnings_of(sim, scene)
    assert "9 of 9 rays" in message
    assert "'robot/foot'" in message
    assert "include_geom_groups=(0,)" in message
    sense(sim)
    # The foot's top is 0.35 m below the base.
    distances = scene["scan"].data.distances
    torch.testing.assert_close(distances, torch.full((1, 9), 0.35), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("group", [0, 2])
def test_the_cure_of_the_message_works_and_leaves_the_robot_visible(group):
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(ROBOT),
        geoms=(GeomCfg(geom_names_expr=(".*",), group=group),),
    )

    def build(sensor):
        scene = Scene(SceneCfg(entities={"robot": robot}, sensors=(sensor,), spec_fn=floor), "cpu")
        return warnings_of(simulation_of(scene, SimulationCfg()), scene)

    (message,) = build(scan())
    assert "include_geom_groups=(0,)" in message
    # A robot in a group of the ground must leave it, for one that viewers show.
    assert ("group=1" in message) == (group == 0)
    if group == 0:
        robot.geoms = (GeomCfg(geom_names_expr=(".*",), group=1),)
    assert build(scan(include_geom_groups=(0,))) == []


@pytest.mark.parametrize(
    "sensor",
    [
        scan(include_geom_groups=(0,)),
        # The rays pass beside the foot.
        scan(frame=ObjRef("site", "left", "robot"), pattern=GridPatternCfg(size=(0.0, 0.0))),
        # The foot is farther away than the rays reach.
        scan(max_distance=0.3),
        # A range finder may look at its robot: its rays turn with the frame, or point elsewhere.
        scan(ray_alignment="base"),
        scan(pattern=GridPatternCfg(size=(0.2, 0.2), direction=(1.0, 0.0, 0.0))),
    ],
)
def test_other_scans_are_silent(sensor):
    assert warnings_of(*scene_with(sensor)) == []


def test_another_entity_may_be_scanned():
    box = '<mujoco><worldbody><body><freejoint/><geom type="box" size=".3 .3 .1"/></body></worldbody></mujoco>'
    sensor = scan(include_geom_groups=(0,))
    assert warnings_of(*scene_with(sensor, entities={"robot": ROBOT, "box": box})) == []


@pytest.mark.parametrize("engine", ["native", "warp"])
@pytest.mark.parametrize(
    ("kind", "groups", "ground"),
    [
        (RayCastSensorCfg, (0,), {"group": 4}),
        (RayCastSensorCfg, (0,), {"rgba": [1.0, 1.0, 1.0, 0.0]}),
        (RayCastSensorCfg, (5,), {}),
        (RayCastSensorCfg, (), {}),
        (TerrainHeightSensorCfg, (), {}),
        (TerrainHeightSensorCfg, (1, 2, 3), {}),
    ],
)
def test_ground_that_no_ray_can_meet_warns_once(kind, groups, ground, engine):
    sensor = scan(kind, include_geom_groups=groups, max_distance=0.3)
    sim, scene = scene_with(sensor, ground=floor_with(**ground), engine=engine)
    (message,) = warnings_of(sim, scene)
    assert "expected a group of the ground" in message
    assert f"include_geom_groups=({ground.get('group', 0)},)" in message
    sense(sim)
    assert (scene["scan"].data.distances == -1.0).all()


@pytest.mark.parametrize("alignment", ["base", "yaw"])
def test_height_observations_warn_once_per_sensor(alignment):
    sim, scene = scene_with(scan(ray_alignment=alignment))
    env = SimpleNamespace(scene=scene, sim=sim)
    with pytest.warns(UserWarning, match="'robot/foot'") as caught:
        scene.check_terrain_scans(sim.mj_model)
        for _ in ("actor", "critic"):
            height_scan(env, "scan")  # ty: ignore
    assert len(caught) == 1
