"""Small worlds for camera sensors."""

from __future__ import annotations

import mujoco

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor.sensor import SensorCfg
from mjlab.sim import Simulation, SimulationCfg

from .simulated import sense as sense
from .simulated import simulation_of

ENGINES = ("native", "warp")

# A sphere above a floor. All numbers are known by hand.
TABLE = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="0 0 1" rgba="1 .5 0 1"/>
  <geom name="ball" type="sphere" size=".5" pos="0 0 1" rgba="0 .5 1 1" group="1"/>
  <geom name="post" type="sphere" size=".2" pos="1.67 1.67 .5" rgba="0 0 0 1" group="3"/>
  <geom name="glass" type="sphere" size=".2" pos="-1.67 1.67 .5" rgba="0 0 0 0" group="3"/>
  <camera name="down" pos="0 0 3" fovy="90"/>
  <camera name="map" pos="0 0 3" fovy="4" projection="orthographic"/>
  <camera name="up" pos="0 0 3" xyaxes="1 0 0 0 -1 0"/>
  <camera name="inside" pos="0 0 1" fovy="60"/>
  <camera name="lens" pos="0 0 3" resolution="1280 720" sensorsize=".003896 .00214"
    focal=".00193 .00193"/>
</worldbody></mujoco>
"""

# Every shape, kind of light and way to lay a texture.
ROOM = f"""
<mujoco>
  <asset>
    <texture name="check" type="2d" builtin="checker" mark="edge" rgb1=".2 .3 .4" rgb2=".1 .2 .3"
      markrgb=".8 .8 .8" width="300" height="300"/>
    <texture name="fade" type="2d" builtin="gradient" rgb1="1 0 0" rgb2="0 0 1" width="64"
      height="64"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".3 .5 .7" rgb2="0 .2 .1" width="64"
      height="64"/>
    <material name="ground" texture="check" texuniform="true" texrepeat="4 4"/>
    <material name="dull" texture="fade" specular=".2" shininess=".1" emission=".1"/>
    <material name="shiny" rgba=".2 .8 .3 1" specular="1" shininess=".9"/>
    <mesh name="tetra" vertex="0 0 .2 .2 0 -.1 -.1 .17 -.1 -.1 -.17 -.1"/>
    <hfield name="hill" nrow="9" ncol="9" size=".4 .4 .2 .1"
      elevation="{" ".join(str(min(r, 8 - r) * min(c, 8 - c) + r * c % 3) for r in range(9) for c in range(9))}"/>
  </asset>
  <worldbody>
    <light name="sun" type="directional" dir=".3 .2 -1" diffuse=".5 .5 .4"/>
    <light name="spot" type="spot" pos="0 -1 2" dir="0 .4 -1" cutoff="30" exponent="10"
      diffuse=".7 .7 .7" specular=".3 .3 .3"/>
    <light name="bulb" type="point" pos="1 1 1" diffuse=".2 .1 .3" attenuation="1 .2 .1"
      ambient=".05 0 0"/>
    <geom name="floor" type="plane" size="0 0 .01" material="ground"/>
    <geom name="wall" type="plane" size=".5 .4 .01" pos="0 1.2 .5" zaxis="0 -1 0" material="dull"/>
    <geom name="box" type="box" size=".15 .1 .2" pos="-.6 0 .2" euler="0 0 30" material="dull"/>
    <geom name="sphere" type="sphere" size=".2" pos="-.1 .3 .2" material="shiny"/>
    <geom name="capsule" type="capsule" size=".08 .2" pos=".35 0 .3" euler="40 0 20"
      rgba=".9 .6 .1 .2"/>
    <geom name="cylinder" type="cylinder" size=".12 .15" pos=".7 .3 .15" material="dull"/>
    <geom name="ellipsoid" type="ellipsoid" size=".1 .2 .15" pos=".1 -.4 .2" material="dull"/>
    <geom name="tetra" type="mesh" mesh="tetra" pos="-.35 -.4 .15" rgba=".7 .2 .8 1"/>
    <geom name="hill" type="hfield" hfield="hill" pos=".8 -.5 .05" rgba=".4 .6 .3 1"/>
    <geom name="screen" type="box" size=".1 .1 .5" pos="0 -.1 .5" group="4"/>
    <camera name="front" pos="0 -1.8 1.1" xyaxes="1 0 0 0 .5 .9"/>
    <camera name="lens" pos="1.2 -1 .9" xyaxes=".6 .8 0 -.4 .3 .9" resolution="1280 720"
      sensorsize=".003896 .00214" focal=".00193 .00193"/>
    <camera name="top" pos=".01 .02 2" projection="orthographic" fovy="2"/>
  </worldbody>
</mujoco>
"""

BALL = """
<mujoco><worldbody><body name="ball" pos="-.2 -.2 .5"><freejoint/>
  <geom name="ball" size=".07" rgba=".9 .1 .1 1"/></body></worldbody></mujoco>
"""


def scene_with(
    *sensors: SensorCfg,
    xml: str = TABLE,
    engine: str = "native",
    num_envs: int = 1,
    extent: float | None = 4.0,
    **more: str,
) -> tuple[Simulation, Scene]:
    """Build a scene of the entity `room` of `xml` and others, with sensors."""
    cfg = SceneCfg(
        num_envs=num_envs,
        extent=extent,
        entities={
            name: EntityCfg(spec_fn=lambda text=text: mujoco.MjSpec.from_string(text))
            for name, text in {"room": xml, **more}.items()
        },
        sensors=sensors,
    )
    scene = Scene(cfg, "cpu")
    return simulation_of(scene, SimulationCfg(engine=engine)), scene
