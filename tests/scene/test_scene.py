"""Composition, keyframe, sensors, access and files of a scene."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import torch

from mjlab.actuator import BuiltinPositionActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sensor import (
    BuiltinSensorCfg,
    ContactMatch,
    ContactSensorCfg,
    ObjRef,
    Sensor,
    SensorCfg,
)
from mjlab.sim import Simulation, SimulationCfg
from mjlab.terrains import (
    HfWaveTerrainCfg,
    TerrainEntityCfg,
    TerrainGeneratorCfg,
)

InitialState = EntityCfg.InitialStateCfg


def build(**fields) -> Scene:
    return Scene(SceneCfg(**fields), "cpu")


# Composition.


def test_the_base_scene_has_looks_and_no_elements():
    model = build().compile()
    assert (model.nbody, model.ngeom, model.nlight, model.ncam) == (1, 0, 0, 0)
    assert model.vis.headlight.diffuse.tolist() == pytest.approx([0.6] * 3)
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1920, 1080)
    assert (model.vis.global_.azimuth, model.vis.global_.elevation) == (135, -25)
    assert model.vis.quality.shadowsize == 8192
    assert model.stat.meansize == pytest.approx(0.03)
    assert model.opt.timestep == mujoco.MjModel.from_xml_string("<mujoco/>").opt.timestep


def test_extent_is_the_configs_or_the_compilers(kit):
    assert build(extent=12.5).compile().stat.extent == 12.5
    alone = build(entities={"box": kit.cfg(kit.BOX)}).compile().stat.extent
    assert 0.0 < alone < 2.0


def test_terrain_comes_first_without_a_prefix_and_entities_with_theirs(kit):
    scene = build(
        terrain=TerrainEntityCfg(),
        entities={"box": kit.cfg(kit.BOX), "cart": kit.cfg(kit.CART)},
    )
    model = scene.compile()
    bodies = [model.body(i).name for i in range(model.nbody)]
    assert bodies == ["world", "terrain", "box/box", "cart/mocap_base", "cart/cart"]
    assert list(scene.entities) == ["terrain", "box", "cart"]
    assert scene.terrain is scene.entities["terrain"] is scene["terrain"]
    assert model.sensor("box/spin").name == "box/spin"
    assert model.actuator("cart/push").name == "cart/push"


def test_entities_with_equal_defaults_meshes_and_materials_do_not_clash():
    xml = """<mujoco><default><default class="leg"><joint damping="{d}"/></default></default>
      <asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><material name="c" rgba="1 0 0 1"/>
      </asset><worldbody><body childclass="leg"><joint name="j"/>
      <geom type="mesh" mesh="m" material="c"/></body></worldbody></mujoco>"""
    cfgs = {
        name: EntityCfg(spec_fn=lambda d=d: mujoco.MjSpec.from_string(xml.format(d=d)))
        for name, d in (("a", 1), ("b", 2))
    }
    model = build(entities=cfgs).compile()
    assert model.dof_damping.tolist() == [1.0, 2.0]
    assert (model.nmesh, model.nmat) == (2, 2)


def test_configs_are_left_as_they_were(kit):
    cfg = SceneCfg(
        num_envs=7,
        env_spacing=5.0,
        terrain=TerrainEntityCfg(),
        entities={"box": kit.cfg(kit.BOX)},
    )
    before = copy.deepcopy(cfg)
    scene = Scene(cfg, "cpu")
    assert (cfg.terrain.num_envs, cfg.terrain.env_spacing) == (1, 2.0)
    assert cfg.terrain == before.terrain
    assert scene.terrain.env_origins.shape == (7, 3)


def test_spec_fn_runs_last(kit):
    def spec_fn(spec):
        assert spec.body("box/box") is not None
        spec.body("box/box").add_site(name="added")
        spec.add_sensor(name="late", type=mujoco.mjtSensor.mjSENS_CLOCK)

    scene = build(entities={"box": kit.cfg(kit.BOX)}, spec_fn=spec_fn)
    assert scene.compile().site("added").bodyid[0] == 1
    assert "late" not in scene.sensors


@pytest.mark.parametrize("name", ["", "a/b", "terrain"])
def test_odd_entity_names_are_accepted(kit, name):
    with pytest.warns(UserWarning, match=f"Entity name {name!r}"):
        sim, scene = kit.make(terrain=TerrainEntityCfg(), entities={name: kit.cfg(kit.BOX)})
    assert scene[name].body_names == ("box",)
    sim.data.qpos[0, 2] = 3.0
    sim.forward()
    assert scene[name].data.root_link_pos_w[0, 2].item() == 3.0


def test_errors_name_the_entity():
    bad = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string("<mujoco><oops/></mujoco>"))
    with pytest.raises(ValueError, match="(?s)Entity 'robot': .*oops"):
        build(entities={"robot": bad})


@pytest.mark.parametrize("num_envs", [0, -3])
def test_the_number_of_environments_must_be_positive(num_envs):
    with pytest.raises(ValueError, match=f"num_envs.*{num_envs}"):
        build(num_envs=num_envs)


# The keyframe.


def test_the_keyframe_holds_the_resolved_state_of_every_entity(kit):
    """The reference lets the XML's own key win, and shifts later controls if it has no ctrl."""
    keyed = kit.CART.replace(
        "</mujoco>", '<keyframe><key name="home" qpos="9"/></keyframe></mujoco>'
    )
    position = EntityArticulationInfoCfg(
        actuators=(
            BuiltinPositionActuatorCfg(target_names_expr=("slider",), stiffness=1.0, damping=0.0),
        )
    )
    scene = build(
        entities={
            "first": kit.cfg(keyed, init_state=InitialState(joint_pos={"slider": 0.1})),
            "box": kit.cfg(kit.BOX, init_state=InitialState(pos=(1.0, 2.0, 3.0))),
            "second": kit.cfg(
                kit.BARE_CART,
                init_state=InitialState(joint_pos={"slider": 0.2}),
                articulation=position,
            ),
        }
    )
    model = scene.compile()
    assert [model.key(i).name for i in range(model.nkey)] == ["init_state"]
    assert model.key("init_state").qpos.tolist() == [0.1, 1, 2, 3, 1, 0, 0, 0, 0.2]
    assert model.key("init_state").ctrl.tolist() == [0.0, 0.2]


def test_the_keyframe_covers_joints_that_the_scene_adds_itself(kit):
    def spec_fn(spec):
        door = spec.worldbody.add_body(name="door")
        door.add_joint(name="hinge", ref=0.25)
        door.add_geom(size=[0.1, 0, 0])
        ball = spec.worldbody.add_body(name="ball", pos=[4, 5, 6])
        ball.add_freejoint()
        ball.add_geom(size=[0.1, 0, 0])

    init = InitialState(joint_pos={"slider": 0.1})
    model = build(entities={"cart": kit.cfg(kit.CART, init_state=init)}, spec_fn=spec_fn).compile()
    key = model.key("init_state").qpos
    assert key[0] == 0.1
    np.testing.assert_allclose(key[1:], model.qpos0[1:])


# Sensors.


def test_named_sensors_of_the_xml_are_there_and_unnamed_ones_left_out(kit):
    """The reference keeps an unnamed sensor under "" and then fails to initialize."""
    sim, scene = kit.make(num_envs=2, entities={"box": kit.cfg(kit.BOX)})
    assert list(scene.sensors) == ["box/spin"]
    sim.data.qvel[:, 3:] = torch.tensor([1.0, 2.0, 3.0])
    sim.forward()
    torch.testing.assert_close(
        scene["box/spin"].data.clone(), torch.tensor([[1.0, 2.0, 3.0]] * 2), atol=1e-5, rtol=0
    )


def height(name: str, entity: str | None = "box") -> BuiltinSensorCfg:
    return BuiltinSensorCfg(
        name=name, sensor_type="framepos", obj=ObjRef("body", "box", entity=entity)
    )


def test_the_last_of_two_sensors_with_one_name_counts(kit):

    class Quiet(Sensor[None]):
        def initialize(self, mj_model, model, data, device):
            pass

        def _compute_data(self):
            return None

    class QuietCfg(SensorCfg):
        def build(self):
            return Quiet()

    with pytest.warns(UserWarning, match="SceneCfg.sensors.*'eye'"):
        scene = build(sensors=(QuietCfg(name="eye"), QuietCfg(name="eye")))
    assert list(scene.sensors) == ["eye"]
    pair = (height("height"), height("height"))
    with (
        pytest.warns(UserWarning, match="SceneCfg.sensors.*'box/height'"),
        pytest.raises(ValueError, match="'box/height'"),
    ):
        build(entities={"box": kit.cfg(kit.BOX)}, sensors=pair)


def test_a_sensor_that_the_xml_has_already_is_refused(kit):
    with pytest.raises(ValueError, match="'box/spin' .*entity 'box'"):
        build(entities={"box": kit.cfg(kit.BOX)}, sensors=(height("spin"),))


def test_caches_are_dropped_by_forward_update_and_reset(kit):
    class Copy(Sensor[torch.Tensor]):
        def initialize(self, mj_model, model, data, device):
            self._sim_data = data

        def _compute_data(self):
            return self._sim_data.xpos[:, 1].clone()

    class CopyCfg(SensorCfg):
        def build(self):
            return Copy()

    sim, scene = kit.make(entities={"box": kit.cfg(kit.BOX)}, sensors=(CopyCfg(name="copy"),))
    sensor = scene["copy"]
    assert sensor.data is sensor.data
    for renew in (
        sim.forward,
        scene.reset,
        lambda: scene.reset(torch.tensor([0])),
        lambda: scene.update(0.1),
    ):
        before = sensor.data
        sim.data.qpos[0, 2] += 1.0
        sim.forward()
        renew()
        assert sensor.data is not before
        torch.testing.assert_close(sensor.data[0, 2], before[0, 2] + 1.0)


def test_force_sensors_keep_their_data(kit):
    touch = ContactSensorCfg(name="touch", primary=ContactMatch("body", "box", entity="box"))

    class Copy(Sensor[torch.Tensor]):
        def initialize(self, mj_model, model, data, device):
            self._sim_data = data

        def _compute_data(self):
            return self._sim_data.xpos[:, 1].clone()

    class CopyCfg(SensorCfg):
        def build(self):
            return Copy()

    sim, scene = kit.make(entities={"box": kit.cfg(kit.BOX)}, sensors=(CopyCfg(name="copy"), touch))
    for stage, kept in (("pos", True), ("vel", True), ("acc", False)):
        before = scene["copy"].data, scene["touch"].data
        sim.forward(stage=stage)
        assert scene["copy"].data is not before[0]
        assert (scene["touch"].data is before[1]) == kept


def test_placed_environments_are_known_for_a_substep(kit):
    sim, scene = kit.make(num_envs=4, entities={"box": kit.cfg(kit.BOX)})
    box = scene["box"]
    assert scene.take_moved_envs() is None
    pose = box.data.default_root_state[:, :7]
    with torch.inference_mode():
        box.write_root_link_pose_to_sim(pose[:1], env_ids=torch.tensor([1]))
    box.write_root_link_pose_to_sim(pose[:1], env_ids=torch.tensor([False, False, False, True]))
    box.write_root_link_velocity_to_sim(torch.zeros(4, 6))
    assert scene.take_moved_envs().tolist() == [False, True, False, True]
    assert scene.take_moved_envs() is None
    box.write_root_link_pose_to_sim(pose)
    scene.update(0.1)
    assert scene.take_moved_envs() is None


def test_only_what_acts_between_substeps_asks_for_them(kit):
    class History(Sensor[None]):
        def initialize(self, mj_model, model, data, device):
            pass

        def _compute_data(self):
            return None

        def update(self, dt):
            super().update(dt)

    class HistoryCfg(SensorCfg):
        def build(self):
            return History()

    def articulated(**delay):
        return EntityArticulationInfoCfg(
            actuators=(
                BuiltinPositionActuatorCfg(
                    target_names_expr=("slider",), stiffness=1.0, damping=0.0, **delay
                ),
            )
        )

    def cart(**delay):
        return {"cart": kit.cfg(kit.BARE_CART, articulation=articulated(**delay))}

    assert not build(entities={**cart(), "box": kit.cfg(kit.BOX)}).needs_substep
    assert build(entities=cart(delay_max_lag=2)).needs_substep
    assert build(entities=cart(), sensors=(HistoryCfg(name="history"),)).needs_substep


# Access.


def test_an_unknown_key_lists_what_there_is(kit):
    scene = build(entities={"box": kit.cfg(kit.BOX)})
    with pytest.raises(KeyError, match=r"'bx'; did you mean 'box'\?.*'box/spin'"):
        _ = scene["bx"]


def test_without_terrain_all_origins_are_zero():
    scene = build(num_envs=3, env_spacing=9.0)
    assert scene.env_origins.tolist() == [[0.0, 0.0, 0.0]] * 3
    assert (scene.env_spacing, scene.num_envs, scene.terrain) == (9.0, 3, None)


def test_a_model_compiled_from_a_copy_of_the_spec_will_do(kit):
    """Unnamed elements are known by their number, which only compiling the spec itself gives."""
    xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    cfg = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(xml))
    scene = build(num_envs=2, entities={"a": cfg, "b": cfg})
    model = scene.spec.copy().compile()
    sim = Simulation(2, SimulationCfg(), model=model, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    assert scene["b"].indexing.geom_ids.tolist() == [1]
    assert scene["b"].indexing.body_ids.tolist() == [2]


def test_reset_reaches_the_targets_of_these_environments(kit):
    _, scene = kit.make(num_envs=3, entities={"cart": kit.cfg(kit.CART)})
    target = scene["cart"].data.joint_pos_target
    target.fill_(1.0)
    scene.reset(torch.tensor([1]))
    assert target.flatten().tolist() == [1.0, 0.0, 1.0]
    scene.reset()
    assert not target.any()


def test_state_of_a_scene_is_captured_and_restored(kit):
    from mjlab.utils.state import capture_state, restore_state

    def fresh():
        return kit.make(num_envs=2, terrain=TerrainEntityCfg(), entities={"c": kit.cfg(kit.CART)})[
            1
        ]

    scene = fresh()
    scene["c"].data.joint_pos_target.fill_(0.7)
    scene["c"].data.encoder_bias.fill_(0.2)
    scene.terrain.env_origins += 1.0
    saved = capture_state(scene)
    again = fresh()
    view = again["c"].data.joint_pos
    restore_state(again, saved)
    assert (again["c"].data.joint_pos_target == 0.7).all()
    assert (again["c"].data.encoder_bias == 0.2).all()
    assert torch.equal(again.env_origins, scene.env_origins)
    assert again["c"].data.joint_pos.data_ptr() == view.data_ptr()


# Files.


def test_a_written_scene_compiles_to_the_same_model(kit, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (tmp_path / "model" / "robot.xml").write_text(
        '<mujoco><asset><mesh name="m" file="m.obj"/></asset><worldbody><body name="b">'
        '<freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    robot = EntityCfg(
        spec_fn=lambda: mujoco.MjSpec.from_file(str(tmp_path / "model" / "robot.xml"))
    )
    scene = build(terrain=TerrainEntityCfg(), entities={"robot": robot, "cart": kit.cfg(kit.CART)})
    model = scene.compile()
    scene.write(tmp_path / "out")
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "scene.xml"))
    np.testing.assert_allclose(again.body_mass, model.body_mass)
    assert again.key("init_state").qpos.tolist() == model.key("init_state").qpos.tolist()
    scene.write(tmp_path / "packed", zip=True)
    assert (tmp_path / "packed.zip").is_file()
    with pytest.warns(DeprecationWarning, match="Scene.write"):
        scene.to_zip(tmp_path / "old.zip")
    assert (tmp_path / "old.zip").is_file()


def test_a_scene_on_height_fields_can_be_written_once_it_is_compiled(tmp_path):
    # The colors of a height field are a texture made from pixels, which XML cannot hold.
    generator = TerrainGeneratorCfg(
        seed=1,
        size=(4.0, 4.0),
        num_rows=2,
        num_cols=2,
        sub_terrains={"waves": HfWaveTerrainCfg(amplitude_range=(0.1, 0.2))},
    )
    scene = build(terrain=TerrainEntityCfg(terrain_type="generator", terrain_generator=generator))
    model = scene.compile()
    scene.write(tmp_path / "out")
    scene.terrain.write_xml(tmp_path / "terrain.xml")
    for path in (tmp_path / "out" / "scene.xml", tmp_path / "terrain.xml"):
        again = mujoco.MjModel.from_xml_path(str(path))
        assert again.nhfield == model.nhfield == 4
        np.testing.assert_array_equal(again.geom_type, model.geom_type)
        np.testing.assert_allclose(again.geom_pos, model.geom_pos, atol=1e-5)
        np.testing.assert_allclose(again.hfield_data, model.hfield_data, atol=1e-5)
