"""MuJoCo's own sensors: what they may be attached to, and what they report."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import BuiltinSensor, BuiltinSensorCfg, ObjRef
from mjlab.sim import Simulation, SimulationCfg
from mjlab.terrains import TerrainEntityCfg

XML = """
<mujoco><worldbody><body name="base"><freejoint/><geom name="g" size=".1" pos=".1 0 0"/>
  <site name="imu" pos=".1 .2 .3" euler="10 20 30"/><camera name="eye"/>
  <body name="leg"><joint name="hip" range="-1 1"/><geom size=".1" pos="0 .2 0"/></body>
</body></worldbody>
<tendon><fixed name="cable"><joint joint="hip" coef="2"/></fixed></tendon>
<actuator><motor name="push" joint="hip"/></actuator></mujoco>
"""


def scene_with(*sensors, num_envs=2, **fields) -> tuple[Simulation, Scene]:
    fields.setdefault("entities", {"r": EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(XML))})
    scene = Scene(SceneCfg(num_envs=num_envs, sensors=sensors, **fields), "cpu")
    sim = Simulation(num_envs, SimulationCfg(), spec=scene.spec, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    return sim, scene


def ref(kind: str) -> ObjRef:
    name = {
        "body": "leg", "xbody": "leg", "joint": "hip", "geom": "g", "site": "imu",
        "actuator": "push", "tendon": "cable", "camera": "eye",
    }[kind]  # fmt: skip
    return ObjRef(kind, name, entity="r")


SITE = ("accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer", "rangefinder")
FRAME = (
    "framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis", "framelinvel",
    "frameangvel", "framelinacc", "frameangacc",
)  # fmt: skip
OBJECTS = {
    **dict.fromkeys(SITE, ("site",)),
    **dict.fromkeys(FRAME, ("body", "xbody", "geom", "site", "camera")),
    **dict.fromkeys(("subtreecom", "subtreelinvel", "subtreeangmom"), ("body",)),
    **{f"joint{x}": ("joint",) for x in ("pos", "vel", "limitpos", "limitvel", "limitfrc")},
    **{f"tendon{x}": ("tendon",) for x in ("pos", "vel")},
    "jointactuatorfrc": ("joint",),
    "tendonactuatorfrc": ("tendon",),
    **{f"actuator{x}": ("actuator",) for x in ("pos", "vel", "frc")},
    **dict.fromkeys(("clock", "e_potential", "e_kinetic"), ()),
}
KINDS = ("body", "xbody", "joint", "geom", "site", "actuator", "tendon", "camera")


def test_all_sensors_on_all_allowed_objects_agree_with_mujoco():
    sensors = [
        BuiltinSensorCfg(
            name=f"{sensor}_{kind}", sensor_type=sensor, obj=ref(kind) if kind else None
        )
        for sensor, kinds in OBJECTS.items()
        for kind in (kinds or (None,))
    ]
    sim, scene = scene_with(*sensors)
    data = mujoco.MjData(sim.mj_model)
    rng = np.random.default_rng(0)
    mujoco.mj_integratePos(sim.mj_model, data.qpos, rng.normal(size=7), 1.0)
    data.qvel[:] = rng.normal(size=7)
    sim.data.qpos[1] = torch.from_numpy(data.qpos).float()
    sim.data.qvel[1] = torch.from_numpy(data.qvel).float()
    mujoco.mj_forward(sim.mj_model, data)
    sim.forward()
    for cfg in sensors:
        expected = data.sensor(cfg.prefixed_name).data
        actual = scene[cfg.prefixed_name].data
        assert actual.shape == (2, len(expected))
        np.testing.assert_allclose(actual[1].numpy(), expected, rtol=1e-3, atol=1e-3)


def test_clock_may_have_an_element():
    sim, scene = scene_with(BuiltinSensorCfg(name="t", sensor_type="clock", obj=ref("site")))
    sim.step(nstep=3)
    sim.forward()
    torch.testing.assert_close(scene["r/t"].data[:, 0], sim.data.time)


def test_unknown_kinds_list_the_known_ones():
    with pytest.raises(ValueError, match="sensor_type.*'accelerometer'.*'gyroo'"):
        scene_with(BuiltinSensorCfg(name="x", sensor_type="gyroo", obj=ref("site")))


def test_a_frame_sensor_reports_in_its_reference_frame():
    cfg = BuiltinSensorCfg(name="rel", sensor_type="framepos", obj=ref("xbody"), ref=ref("site"))
    sim, scene = scene_with(cfg)
    sim.data.qpos[:, :3] = 5.0
    sim.forward()
    # Both belong to one body, so where the world puts that body does not matter.
    site = mujoco.MjData(sim.mj_model)
    mujoco.mj_forward(sim.mj_model, site)
    expected = site.sensor("r/rel").data
    np.testing.assert_allclose(scene["r/rel"].data[0].numpy(), expected, atol=1e-5)


def test_cutoff_is_written_only_if_positive():
    sensors = [
        BuiltinSensorCfg(name=name, sensor_type="gyro", obj=ref("site"), cutoff=cutoff)
        for name, cutoff in (("on", 2.0), ("off", 0.0))
    ]
    sim, _ = scene_with(*sensors)
    assert sim.mj_model.sensor("r/on").cutoff[0] == 2.0
    assert sim.mj_model.sensor("r/off").cutoff[0] == 0.0


def test_names_with_and_without_an_entity():
    own = BuiltinSensorCfg(name="gyro", sensor_type="gyro", obj=ref("site"))
    world = BuiltinSensorCfg(name="gyro", sensor_type="gyro", obj=ObjRef("site", "r/imu"))
    assert own.prefixed_name == "r/gyro"
    assert world.prefixed_name == "gyro"
    _, scene = scene_with(own, world)
    assert list(scene.sensors) == ["r/gyro", "gyro"]
    assert torch.equal(scene["r/gyro"].data, scene["gyro"].data)


def test_elements_of_the_terrain_are_found_though_it_has_no_prefix():
    ground = ObjRef("geom", "terrain", entity="terrain")
    above = BuiltinSensorCfg(name="above", sensor_type="framepos", obj=ref("body"), ref=ground)
    below = BuiltinSensorCfg(name="below", sensor_type="framepos", obj=ground, ref=ref("body"))
    sim, scene = scene_with(above, below, terrain=TerrainEntityCfg())
    sim.data.qpos[:, 2] = 3.0
    sim.forward()
    assert scene["r/above"].data[0, 2] == -scene["terrain/below"].data[0, 2] == 3.0
    wrong = BuiltinSensorCfg(
        name="x", sensor_type="framepos", obj=ObjRef("xbody", "base", entity="terrain")
    )
    with pytest.raises(ValueError, match=r"'base' .*entity 'terrain'.*\['world', 'terrain'\]"):
        scene_with(wrong, terrain=TerrainEntityCfg())


def test_an_entity_called_terrain_has_its_prefix_where_there_is_no_terrain():
    rocks = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(XML))
    cfg = BuiltinSensorCfg(
        name="where", sensor_type="framepos", obj=ObjRef("site", "imu", entity="terrain")
    )
    sim, _ = scene_with(cfg, entities={"terrain": rocks})
    sensor = sim.mj_model.sensor("terrain/where")
    assert sensor.objid[0] == sim.mj_model.site("terrain/imu").id


def test_unknown_elements_and_entities_list_the_candidates():
    site = BuiltinSensorCfg(name="x", sensor_type="gyro", obj=ObjRef("site", "imuu", entity="r"))
    with pytest.raises(ValueError, match=r"site 'imuu' .*entity 'r'.*\['imu'\]"):
        scene_with(site)
    entity = BuiltinSensorCfg(name="x", sensor_type="gyro", obj=ObjRef("site", "imu", entity="q"))
    with pytest.raises(ValueError, match=r"entity 'q'.*\['r'\]"):
        scene_with(entity)


def test_data_is_a_view_of_the_simulation():
    cfg = BuiltinSensorCfg(name="clock", sensor_type="clock")
    sim, scene = scene_with(cfg)
    data = scene["clock"].data
    assert data.untyped_storage().data_ptr() == sim.data.sensordata.untyped_storage().data_ptr()


def test_an_unread_sensor_costs_nothing():
    """Access to sensordata makes the native engine copy it out at every step."""
    asked = []

    class Recorder:
        def __getattr__(self, name):
            asked.append(name)
            return getattr(sim.data, name)

    sim, scene = scene_with(BuiltinSensorCfg(name="clock", sensor_type="clock"))
    sensor = scene["clock"]
    sensor.initialize(sim.mj_model, sim.model, Recorder(), "cpu")
    sensor.update(0.1)
    sensor.reset()
    assert asked == []
    assert sensor.data.shape == (2, 1)
    assert asked == ["sensordata"]


def test_a_sensor_is_made_from_a_config_or_from_a_name():
    with pytest.raises(ValueError, match="exactly one"):
        BuiltinSensor()
    assert not BuiltinSensor.from_existing("r/gyro").needs_substep
