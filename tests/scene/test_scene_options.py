"""Simulation options in the XML of entities: overridden by `MujocoCfg`, or applied to the scene."""

from __future__ import annotations

import logging
import warnings

import mujoco
import pytest

from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg


def build(spec_fn=None, **entities) -> Scene:
    return Scene(SceneCfg(entities=entities, spec_fn=spec_fn), "cpu")


@pytest.fixture(params=["BOX", "CART"])
def xml(kit, request):
    """A floating entity, and a fixed one, whose wrapping the reference lets drop its options."""
    return getattr(kit, request.param)


def reports(scene: Scene, cfg: MujocoCfg, caplog) -> list[str]:
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        scene.report_overruled_options(cfg)
    return [record.getMessage() for record in caplog.records]


def options_of(model: mujoco.MjModel) -> dict:
    names = [name for name in dir(model.opt) if not name.startswith("_")]
    return {name: str(getattr(model.opt, name)) for name in names}


def test_the_config_decides_and_reports_differences(kit, xml, caplog):
    scene = build(robot=kit.cfg(xml, 'timestep=".01" cone="elliptic" impratio="7"/>'))
    assert reports(scene, MujocoCfg(cone="elliptic"), caplog) == [
        "Option timestep is 0.002, from MujocoCfg; to follow the XML of 'robot', "
        "set sim.mujoco.timestep = 0.01",
        "Option impratio is 1.0, from MujocoCfg; to follow the XML of 'robot', "
        "set sim.mujoco.impratio = 7.0",
    ]
    sim = Simulation(1, SimulationCfg(), spec=scene.spec, device="cpu")
    assert sim.mj_model.opt.timestep == 0.002
    assert sim.mj_model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def test_gravity_of_an_xml_is_a_warning_with_the_assignment(kit, xml, caplog):
    scene = build(robot=kit.cfg(xml, 'gravity="0 0 -1.62"/>'))
    with pytest.warns(UserWarning, match="Gravity is .*-9.81.*, not .*-1.62.*'robot'") as seen:
        assert reports(scene, MujocoCfg(), caplog) == []
    sim = SimulationCfg()
    exec(str(seen[0].message).rstrip(".").partition(", set ")[2], {"sim": sim})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reports(scene, sim.mujoco, caplog) == []


@pytest.mark.parametrize("gravity", ["0 0 -9.8", "0 0 -9.80665", "0 0 -9.81"])
def test_rounding_of_gravity_is_no_warning(kit, gravity, caplog):
    scene = build(robot=kit.cfg(kit.BOX, f'gravity="{gravity}"/>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reports(scene, MujocoCfg(), caplog) == []


def test_an_xml_that_switches_gravity_off_is_a_warning(kit, xml, caplog):
    scene = build(robot=kit.cfg(xml, '><flag gravity="disable"/></option>'))
    with pytest.warns(UserWarning, match="Gravity is off in the whole scene.*'robot'"):
        assert reports(scene, MujocoCfg(), caplog) == []


def test_the_assignment_that_is_reported_silences_the_report(kit, xml, caplog):
    scene = build(robot=kit.cfg(xml, 'timestep=".01" integrator="RK4" impratio="7"/>'))
    sim = SimulationCfg()
    for line in reports(scene, sim.mujoco, caplog):
        exec(line.partition(", set ")[2], {"sim": sim})
    assert (sim.mujoco.timestep, sim.mujoco.integrator, sim.mujoco.impratio) == (0.01, "rk4", 7)
    assert reports(scene, sim.mujoco, caplog) == []


def test_an_option_written_out_counts_even_at_mujocos_default(kit, caplog):
    """MujocoCfg defaults to implicitfast; an XML that says Euler means it."""
    assert reports(build(robot=kit.cfg(kit.CART)), MujocoCfg(), caplog) == []
    spoken = build(robot=kit.cfg(kit.CART, 'integrator="Euler"/>'))
    assert "sim.mujoco.integrator = 'euler'" in reports(spoken, MujocoCfg(), caplog)[0]


def test_spec_and_environment_have_one_set_of_options(kit, caplog):
    options = (
        'timestep=".01" integrator="Euler" density="7" noslip_iterations="3"'
        '><flag contact="disable"/></option>'
    )
    entity = kit.cfg(kit.CART, options)
    cfg = SimulationCfg(engine="native", mujoco=MujocoCfg(disableflags=("limit",)))
    alone = Simulation(1, cfg, spec=entity.spec_fn(), device="cpu")
    scene_cfg = SceneCfg(num_envs=1, entities={"robot": entity})
    with caplog.at_level(logging.WARNING):
        env = ManagerBasedRlEnv(
            ManagerBasedRlEnvCfg(
                decimation=1, scene=scene_cfg, sim=cfg, observations={}, actions={}
            ),
            device="cpu",
        )
    assert "set sim.mujoco.timestep = 0.01" in caplog.text
    composed = Simulation(1, cfg, spec=build(robot=entity).spec, device="cpu")
    assert options_of(env.sim.mj_model) == options_of(composed.mj_model)
    assert options_of(env.sim.mj_model) == options_of(alone.mj_model)
    assert env.sim.mj_model.opt.density == 7.0
    assert env.physics_dt == 0.002
    env.close()


@pytest.mark.parametrize(
    ("attribute", "value", "field"),
    [
        ("timestep", ".002", "timestep"), ("impratio", "1", "impratio"),
        ("tolerance", "1e-8", "tolerance"), ("ls_tolerance", ".01", "ls_tolerance"),
        ("noslip_tolerance", "1e-6", "noslip_tolerance"),
        ("ccd_tolerance", "1e-6", "ccd_tolerance"), ("gravity", "0 0 -9.81", "gravity"),
        ("wind", "0 0 0", "wind"), ("magnetic", "0 -.5 0", "magnetic"),
        ("density", "0", "density"), ("viscosity", "0", "viscosity"),
        ("o_margin", "0", "o_margin"), ("o_solref", ".02 1", "o_solref"),
        ("integrator", "Euler", "integrator"), ("cone", "pyramidal", "cone"),
        ("jacobian", "auto", "jacobian"), ("solver", "Newton", "solver"),
        ("iterations", "100", "iterations"), ("ls_iterations", "50", "ls_iterations"),
        ("noslip_iterations", "0", "noslip_iterations"),
        ("ccd_iterations", "35", "ccd_iterations"), ("sdf_iterations", "10", "sdf_iterations"),
        ("sdf_initpoints", "40", "sdf_initpoints"),
    ],
)  # fmt: skip
def test_every_option_written_out_is_recognized(kit, attribute, value, field):
    """Guards the order of MuJoCo's bits, which tell written values from open ones."""
    entity = kit.cfg(kit.CART, f'{attribute}="{value}"/>').build()
    assert list(entity.options.values) == [field]


def test_options_set_in_code_are_recognized(kit):
    def spec_fn():
        spec = mujoco.MjSpec.from_string(kit.BOX.format(option=""))
        spec.option.timestep = 0.01
        spec.option.wind[:] = (1.0, 0.0, 0.0)
        return spec

    cfg = kit.cfg(kit.BOX)
    cfg.spec_fn = spec_fn
    assert cfg.build().options.values == {"timestep": 0.01, "wind": (1.0, 0.0, 0.0)}


def test_options_that_the_config_lacks_reach_the_compiled_model(kit, xml, caplog):
    scene = build(robot=kit.cfg(xml, 'density="1000" wind="1 2 3" noslip_iterations="4"/>'))
    assert reports(scene, MujocoCfg(), caplog) == []
    sim = Simulation(1, SimulationCfg(), spec=scene.spec, device="cpu")
    assert sim.mj_model.opt.density == 1000.0
    assert sim.mj_model.opt.wind.tolist() == [1.0, 2.0, 3.0]
    assert sim.mj_model.opt.noslip_iterations == 4


def test_flags_add_up_with_those_of_the_config(kit, xml, caplog):
    scene = build(
        robot=kit.cfg(xml, '><flag contact="disable" energy="enable"/></option>'),
        other=kit.cfg(kit.BOX, '><flag limit="disable" gravity="enable"/></option>'),
    )
    cfg = MujocoCfg(disableflags=("gravity",))
    assert reports(scene, cfg, caplog)[0] == (
        "Option disableflags is ('gravity',), from MujocoCfg; to follow the XML of 'other', "
        "set sim.mujoco.disableflags = ()"
    )
    sim = Simulation(1, SimulationCfg(mujoco=cfg), spec=scene.spec, device="cpu")
    for flag in ("CONTACT", "LIMIT", "GRAVITY"):
        assert sim.mj_model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")
    assert sim.mj_model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY


def test_flags_of_an_xml_are_reported_as_applying_with_the_assignment(kit, xml, caplog):
    scene = build(
        robot=kit.cfg(xml, '><flag contact="disable" energy="enable"/></option>'),
        other=kit.cfg(kit.BOX, '><flag contact="disable" gravity="disable"/></option>'),
        plain=kit.cfg(kit.BOX, '><flag gravity="disable"/></option>'),
    )
    sim = SimulationCfg(mujoco=MujocoCfg(disableflags=("gravity",)))
    lines = reports(scene, sim.mujoco, caplog)
    assert lines == [
        "Option disableflags is ('gravity',), from MujocoCfg, plus ('contact',), from the XML of "
        "'robot' and the XML of 'other' (applied to the whole scene); to configure it, "
        "set sim.mujoco.disableflags = ('gravity', 'contact')",
        "Option enableflags is (), from MujocoCfg, plus ('energy',), from the XML of 'robot' "
        "(applied to the whole scene); to configure it, "
        "set sim.mujoco.enableflags = ('energy',)",
    ]
    for line in lines:
        exec(line.partition(", set ")[2], {"sim": sim})
    assert reports(scene, sim.mujoco, caplog) == []


def test_entities_that_disagree_are_reported(kit):
    with pytest.warns(UserWarning, match="not applied") as caught:
        scene = build(
            one=kit.cfg(kit.BOX, 'timestep=".01" density="7" viscosity="1"/>'),
            two=kit.cfg(kit.CART, 'timestep=".02" density="7" viscosity="2"/>'),
        )
    text = str(caught[0].message)
    assert "viscosity: 1.0 (one), 2.0 (two)" in text
    # MujocoCfg overrides the timestep.
    assert "timestep" not in text
    assert "density" not in text
    assert scene.compile().opt.density == 7.0
    assert scene.compile().opt.viscosity == 0.0


def test_entities_that_disagree_about_a_flag_keep_their_other_flags(kit, caplog):
    with pytest.warns(UserWarning, match="not applied") as caught:
        scene = build(
            one=kit.cfg(kit.BOX, '><flag contact="disable" limit="disable"/></option>'),
            two=kit.cfg(kit.CART, '><flag contact="enable"/></option>'),
        )
    text = str(caught[0].message)
    assert "disableflags: one sets ['contact']" in text
    assert "two sets [] and clears ['contact']" in text
    flags = scene.compile().opt.disableflags
    assert flags == mujoco.mjtDisableBit.mjDSBL_LIMIT
    (line,) = reports(scene, MujocoCfg(), caplog)
    assert "plus ('limit',), from the XML of 'one'" in line


def test_the_scenes_own_edits_win_and_are_reported(kit):
    def spec_fn(spec):
        spec.option.density = 5.0

    with pytest.warns(UserWarning, match=r"density: 5.0 .* 7.0 \(robot\)"):
        scene = build(spec_fn, robot=kit.cfg(kit.BOX, 'density="7" viscosity="1"/>'))
    assert scene.compile().opt.density == 5.0
    assert scene.compile().opt.viscosity == 1.0
    assert set(scene.entity_options) == {"viscosity"}


def test_an_option_of_the_config_that_the_scene_edits_is_reported(kit, caplog):
    def spec_fn(spec):
        spec.option.timestep = 0.01

    scene = build(spec_fn, robot=kit.cfg(kit.BOX))
    (line,) = reports(scene, MujocoCfg(), caplog)
    assert "to follow SceneCfg.spec_fn, set sim.mujoco.timestep = 0.01" in line


def test_the_entitys_own_spec_keeps_working_alone(kit):
    """MuJoCo itself would warn about every option it drops; nothing is dropped here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = build(robot=kit.cfg(kit.CART, 'density="7"/>'))
        scene.spec.to_xml()
        scene.compile()
