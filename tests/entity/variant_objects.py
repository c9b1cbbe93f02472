"""Things that have one structure, a body with a lid on a hinge, and differ in all else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import torch

from mjlab.entity import EntityCfg, VariantEntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import SensorCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

# With faces, because of vertices alone MuJoCo always makes the hull.
WEDGE = 'vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2" face="0 2 1 0 1 3 0 3 2 1 2 3"'
STEEP = 'vertex="-.1 -.1 0 .1 -.1 0 0 .15 0 0 0 .3" face="0 2 1 0 1 3 0 3 2 1 2 3"'

XML = """
<mujoco model="{name}">
  <asset>
    <mesh name="wedge" {wedge}/><mesh name="steep" {steep}/>
    <material name="paint" rgba="{paint}"/>
  </asset>
  <worldbody>
    <body name="thing" pos="0 0 .1">
      <freejoint name="root"/>
      {geoms}
      <site name="grip" pos="0 0 .1"/>
      <body name="lid" pos="0 0 .3">
        <joint name="hinge" axis="1 0 0" damping=".02" stiffness="2" armature="{armature}"/>
        <geom name="cover" type="box" size="{cover}" density="200" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def thing(
    name: str,
    geoms: str,
    armature: float = 0.01,
    cover: str = ".05 .05 .01",
    paint: str = "1 0 0 1",
    **replaced: str,
) -> Callable[[], mujoco.MjSpec]:
    """Return a function that makes the spec; `replaced` are pieces of the XML to change."""
    xml = XML.format(
        name=name,
        geoms=geoms,
        armature=armature,
        cover=cover,
        paint=paint,
        wedge=WEDGE,
        steep=STEEP,
    )
    for old, new in replaced.items():
        assert old in xml
        xml = xml.replace(old, new)
    return lambda: mujoco.MjSpec.from_string(xml)


BOX = thing("box", '<geom name="shell" type="box" size=".1 .1 .1" friction=".3" rgba="0 1 0 1"/>')
BALL = thing(
    "ball",
    '<geom name="shell" type="sphere" size=".15" material="paint" solref=".01 1.2"/>',
    armature=0.03,
)
DUMBBELL = thing(
    "dumbbell",
    '<geom type="sphere" size=".06" pos=".12 0 0" priority="1"/>'
    '<geom type="sphere" size=".06" pos="-.12 0 0" friction=".5" solimp=".8 .9 .002 .4 3"'
    ' solmix=".5" margin=".004" gap=".003"/>'
    '<geom type="capsule" size=".02 .1" euler="0 90 0" contype="0" conaffinity="0" mass="0"/>',
    cover=".02 .06 .01",
)
MESH = thing(
    "mesh",
    '<geom type="mesh" mesh="wedge" material="paint"/>'
    '<geom type="mesh" mesh="steep" contype="0" conaffinity="0" group="2" mass="0"/>',
    paint="0 0 1 1",
)
ROUGH_MESH = thing(
    "rough",
    '<geom type="mesh" mesh="steep" condim="4" friction="1.5 .02 .001" margin=".002"'
    ' solimp=".85 .95 .003 .5 2"/>'
    '<geom type="mesh" mesh="wedge" contype="0" conaffinity="0" group="3" mass="0"/>',
)

THINGS = {"box": BOX, "ball": BALL, "dumbbell": DUMBBELL, "mesh": MESH, "rough": ROUGH_MESH}
"""Primitives of several types and numbers, meshes, and one of another condim."""

BEADS = {
    name: (
        lambda size=size: mujoco.MjSpec.from_string(
            f'<mujoco><worldbody><body name="bead"><freejoint/><geom name="bead" size="{size}"/>'
            "</body></worldbody></mujoco>"
        )
    )
    for name, size in (("small", 0.03), ("large", 0.05))
}
"""Spheres: the same geom in other sizes."""


def make_scene(
    num_envs: int, entities: Mapping[str, EntityCfg], sensors: tuple[SensorCfg, ...] = ()
) -> Scene:
    """Return a scene with a plane."""
    plane = TerrainEntityCfg(terrain_type="plane")
    cfg = SceneCfg(num_envs=num_envs, terrain=plane, entities=dict(entities), sensors=sensors)
    return Scene(cfg, device="cpu")


def simulate(scene: Scene, engine: Any = "native", **options: Any) -> Simulation:
    """Compile a scene and tie it to a simulation."""
    cfg = SimulationCfg(
        engine=engine, num_threads=1, mujoco=MujocoCfg(timestep=0.004, iterations=50), **options
    )
    sim = Simulation(
        scene.num_envs,
        cfg,
        spec=scene.spec,
        device="cpu",
        variant_info=scene.collect_variant_info(),
    )
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return sim


def plain(make: Callable[[], mujoco.MjSpec], like: VariantEntityCfg | None = None) -> EntityCfg:
    """Return the config of a thing that is the same everywhere."""
    collisions = () if like is None else like.collisions
    return EntityCfg(spec_fn=make, collisions=collisions)


def present_geoms(sim: Simulation, env: int, body: str) -> Iterable[int]:
    """Return the geoms that an environment has in a body, ascending."""
    body_id = sim.mj_model.body(body).id
    ids = [i for i in range(sim.mj_model.ngeom) if sim.mj_model.geom_bodyid[i] == body_id]
    absent = sim.absent_geoms
    return [i for i in ids if absent is None or not absent[env, i]]


def place(sim: Simulation, qpos: torch.Tensor) -> None:
    """Start all environments at `qpos`, at rest."""
    sim.reset()
    sim.data.qpos[:] = qpos
    sim.data.qvel[:] = 0.0
    sim.forward()
