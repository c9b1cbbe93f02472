"""Small worlds for ray sensors, where the answer is known by hand."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import ObjRef
from mjlab.sensor.sensor import SensorCfg
from mjlab.sim import Simulation, SimulationCfg

from .simulated import sense as sense
from .simulated import simulation_of

ROBOT = """
<mujoco><worldbody><body name="base" pos="0 0 1"><freejoint/>
  <geom name="shell" type="sphere" size=".2" group="2"/>
  <site name="left" pos="0 .5 0"/><site name="right" pos="0 -.5 0"/>
  <camera name="eye" fovy="60" resolution="8 4"/>
  <camera name="lens" resolution="4 2" sensorsize=".02 .01" focal=".01 .02" principal=".002 .001"/>
  <body name="leg" pos="0 0 -.4"><joint name="knee" axis="0 1 0"/>
    <geom name="foot" type="box" size=".1 .1 .05" group="2"/></body>
</body></worldbody></mujoco>
"""

BASE = ObjRef("body", "base", entity="robot")

Edit = Callable[[mujoco.MjSpec], None]


def floor(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])


def field_of(heights: list[list[float]], size=(2.0, 2.0, 1.0, 0.5), pos=(0.0, 0.0, 0.0)) -> Edit:
    """A height field; its elevations are 0 to 1, and its rows go along +y."""

    def edit(spec: mujoco.MjSpec) -> None:
        rows = torch.tensor(heights)
        name = f"field{len(list(spec.hfields))}"
        spec.add_hfield(
            name=name,
            nrow=rows.shape[0],
            ncol=rows.shape[1],
            size=list(size),
            userdata=rows.flatten().tolist(),
        )
        spec.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=name, pos=list(pos)
        )

    return edit


def scene_with(
    *sensors: SensorCfg,
    ground: Edit = floor,
    num_envs: int = 1,
    engine: str = "native",
    entities: dict[str, str] | None = None,
) -> tuple[Simulation, Scene]:
    specs = entities or {"robot": ROBOT}
    cfgs = {
        name: EntityCfg(spec_fn=lambda xml=xml: mujoco.MjSpec.from_string(xml))
        for name, xml in specs.items()
    }
    cfg = SceneCfg(num_envs=num_envs, entities=cfgs, sensors=sensors, spec_fn=ground)
    scene = Scene(cfg, "cpu")
    return simulation_of(scene, SimulationCfg(engine=engine)), scene
