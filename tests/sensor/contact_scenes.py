"""Small scenes with contacts, and what plain MuJoCo says about them."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import ContactMatch, ContactSensorCfg, SensorCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from mjlab.terrains.terrain_entity import TerrainEntityCfg

from .simulated import simulation_of

DT = 0.004
GRAVITY = 9.81

BOX = """
<mujoco><worldbody><body name="box" pos="0 0 .0999"><freejoint/>
  <geom name="box" type="box" size=".1 .1 .1" mass="2"/></body></worldbody></mujoco>
"""

# Its weight is off the middle, so that all four contact forces are different.
LOPSIDED = """
<mujoco><worldbody><body name="box" pos="0 0 .1"><freejoint/>
  <geom name="box" type="box" size=".1 .1 .1" mass="1" friction=".6"/>
  <geom name="load" type="sphere" size=".02" pos=".02 .01 .12" mass="1"/></body></worldbody></mujoco>
"""

LEGS = """
<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/>
  <geom name="trunk_collision" type="box" size=".1 .1 .02"/>
  <body name="left"><joint name="left" type="slide"/><geom name="left_foot" size=".02" pos="0 .05 -.1"/>
    <geom name="left_shin" size=".01" pos="0 .05 -.05"/></body>
  <body name="right"><joint name="right" type="slide"/><geom name="right_foot" size=".02" pos="0 -.05 -.1"/>
    <geom name="right_shin" size=".01" pos="0 -.05 -.05"/></body>
</body></worldbody></mujoco>
"""

TERRAIN = ContactMatch(mode="body", pattern="terrain")


def geom(pattern: str | tuple[str, ...], entity: str | None = "box", **fields) -> ContactMatch:
    return ContactMatch(mode="geom", pattern=pattern, entity=entity, **fields)


def body(pattern: str | tuple[str, ...], entity: str | None = "box", **fields) -> ContactMatch:
    return ContactMatch(mode="body", pattern=pattern, entity=entity, **fields)


def subtree(pattern: str, entity: str | None = "box", **fields) -> ContactMatch:
    return ContactMatch(mode="subtree", pattern=pattern, entity=entity, **fields)


def compose(*sensors: SensorCfg, num_envs: int = 2, terrain: bool = True, **entities: str) -> Scene:
    """Compose a scene of entities given as XML, on the ground."""
    return Scene(
        SceneCfg(
            num_envs=num_envs,
            terrain=TerrainEntityCfg() if terrain else None,
            entities={
                name: EntityCfg(spec_fn=lambda xml=xml: mujoco.MjSpec.from_string(xml))
                for name, xml in entities.items()
            },
            sensors=sensors,
        ),
        device="cpu",
    )


def simulate(
    scene: Scene, engine: str = "native", sim: SimulationCfg | None = None, **options
) -> Simulation:
    """Tie a scene to a simulation."""
    cfg = sim or SimulationCfg()
    cfg.engine = engine
    cfg.num_threads = 1
    cfg.mujoco = MujocoCfg(timestep=DT, **options)
    return simulation_of(scene, cfg)


def build(*sensors: SensorCfg, engine: str = "native", gravity=None, cone="elliptic", **parts):
    """Compose a scene and tie it to a simulation; returns both."""
    scene = compose(*sensors, **parts)
    gravity = (0.0, 0.0, -GRAVITY) if gravity is None else gravity
    return simulate(scene, engine, gravity=gravity, cone=cone), scene


def settle(sim: Simulation, steps: int = 400) -> None:
    sim.step(nstep=steps)
    sim.forward()


def sense(primary: ContactMatch, secondary: ContactMatch | None = None, **fields):
    """Describe a sensor called `touch`."""
    return ContactSensorCfg(name="touch", primary=primary, secondary=secondary, **fields)


@dataclass
class Contact:
    """A contact as plain MuJoCo has it, seen from one of its geoms."""

    force: np.ndarray
    """In the world frame, on the other geom."""
    torque: np.ndarray
    dist: float
    pos: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    normal_force: float


def plain_contacts(sim: Simulation, primary: str, env: int = 0) -> list[Contact]:
    """Return all contacts of a geom in one environment, from `mj_contactForce`, in MuJoCo's order."""
    model = sim.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = sim.data.qpos[env].numpy()
    data.qvel[:] = sim.data.qvel[env].numpy()
    data.qacc_warmstart[:] = sim.data.qacc_warmstart[env].numpy()
    mujoco.mj_forward(model, data)
    contacts = []
    for index in range(data.ncon):
        contact = data.contact[index]
        names = [model.geom(int(one)).name for one in contact.geom]
        if primary not in names:
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, index, wrench)
        axes = contact.frame.reshape(3, 3)
        # MuJoCo's normal points from the first geom to the second, and its force acts on the second.
        sign = 1.0 if names[0] == primary else -1.0
        contacts.append(
            Contact(
                force=sign * (axes.T @ wrench[:3]),
                torque=sign * (axes.T @ wrench[3:]),
                dist=float(contact.dist),
                pos=contact.pos.copy(),
                normal=sign * axes[0],
                tangent=sign * axes[1],
                normal_force=float(wrench[0]),
            )
        )
    return contacts


def stack(contacts: list[Contact], field: str) -> torch.Tensor:
    """Return one field of several contacts as a float tensor."""
    return torch.tensor(np.array([getattr(one, field) for one in contacts]), dtype=torch.float32)
