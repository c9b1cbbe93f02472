"""Terrain scans see the ground, and not the robot that carries them."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import pytest

from mjlab.entity import EntityCfg
from mjlab.envs.mdp import height_scan
from mjlab.managers.term_checks import check_term
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import GridPatternCfg, ObjRef, RayCastSensorCfg, TerrainHeightSensorCfg
from mjlab.sim import SimulationCfg
from mjlab.utils.spec_config import GeomCfg

from .ray_scenes import BASE, ROBOT, floor, scene_with
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


def check(sensor, ground=floor, **kwargs) -> None:
    sim, scene = scene_with(sensor, ground=ground, **kwargs)
    scene.check_terrain_scans(sim.mj_model)


@pytest.mark.parametrize("groups", [(0, 1, 2), None])
@pytest.mark.parametrize("kind", [RayCastSensorCfg, TerrainHeightSensorCfg])
@pytest.mark.parametrize("alignment", ["yaw", "world"])
def test_a_scan_that_meets_its_own_robot_is_an_error(kind, groups, alignment):
    with pytest.raises(ValueError, match=r"'scan'.* 9 of 9 rays .*'robot/foot'"):
        check(scan(kind, include_geom_groups=groups, ray_alignment=alignment))


@pytest.mark.parametrize("group", [0, 2])
def test_the_cure_of_the_message_works_and_leaves_the_robot_visible(group):
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_string(ROBOT),
        geoms=(GeomCfg(geom_names_expr=(".*",), group=group),),
    )

    def build(sensor):
        scene = Scene(SceneCfg(entities={"robot": robot}, sensors=(sensor,), spec_fn=floor), "cpu")
        scene.check_terrain_scans(simulation_of(scene, SimulationCfg()).mj_model)

    with pytest.raises(ValueError, match=r"include_geom_groups=\(0,\)") as error:
        build(scan())
    # A robot in a group of the ground has to leave it, for one that viewers show.
    assert ("group=1" in str(error.value)) == (group == 0)
    if group == 0:
        robot.geoms = (GeomCfg(geom_names_expr=(".*",), group=1),)
    build(scan(include_geom_groups=(0,)))


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
    check(sensor)


def test_another_entity_may_be_scanned():
    box = '<mujoco><worldbody><body><freejoint/><geom type="box" size=".3 .3 .1"/></body></worldbody></mujoco>'
    check(scan(include_geom_groups=(0,)), entities={"robot": ROBOT, "box": box})


@pytest.mark.parametrize("fields", [{"group": 4}, {"rgba": [1.0, 1.0, 1.0, 0.0]}])
def test_ground_that_no_ray_can_meet_is_an_error(fields):
    with pytest.raises(
        ValueError, match=r"'scan' include_geom_groups: expected a group of the ground"
    ):
        check(scan(include_geom_groups=(0,)), ground=floor_with(**fields))


def test_a_world_without_ground_is_no_error():
    check(scan(include_geom_groups=(0,)), ground=lambda spec: None)


def test_a_height_observation_needs_a_scan_whatever_its_alignment():
    sim, scene = scene_with(scan(ray_alignment="base"))
    env = SimpleNamespace(scene=scene, sim=sim)
    with pytest.raises(ValueError, match="'robot/foot'"):
        check_term(height_scan, env, {"sensor_name": "scan"})  # ty: ignore
