"""Simulation options in the XML of entities: applied, unless somebody contradicts them."""

from __future__ import annotations

import logging
import warnings

import mujoco
import pytest

from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg


def build(spec_fn=None, **entities) -> Scene:
    return Scene(SceneCfg(entities=entities, spec_fn=spec_fn), "cpu")


@pytest.fixture(params=["BOX", "CART"])
def xml(kit, request):
    """A floating entity, and a fixed one, whose wrapping the reference lets drop its options."""
    return getattr(kit, request.param)


def test_an_option_nobody_contradicts_is_applied_and_logged(kit, xml, caplog):
    with warnings.catch_warnings(), caplog.at_level(logging.INFO):
        warnings.simplefilter("error")
        scene = build(robot=kit.cfg(xml, 'timestep=".01" gravity="0 0 -1" cone="elliptic"/>'))
        cfg = MujocoCfg()
        resolved = scene.resolve_mujoco_cfg(cfg)
    assert (resolved.timestep, resolved.gravity, resolved.cone) == (0.01, (0, 0, -1), "elliptic")
    assert resolved.solver == "newton"
    assert cfg == MujocoCfg(), "the user's config was changed"
    assert "MujocoCfg.timestep = 0.01, as the XML of robot asks." in caplog.text


def test_a_contradicting_config_wins_and_is_reported(kit, xml):
    scene = build(robot=kit.cfg(xml, 'timestep=".01" cone="elliptic"/>'))
    with pytest.warns(UserWarning, match=r"timestep: 0.005, not 0.01 as robot") as caught:
        resolved = scene.resolve_mujoco_cfg(MujocoCfg(timestep=0.005))
    assert resolved.timestep == 0.005
    assert resolved.cone == "elliptic"
    assert "cone" not in str(caught[0].message)


def test_a_config_that_agrees_is_not_reported(kit, xml):
    scene = build(robot=kit.cfg(xml, 'timestep=".005"/>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene.resolve_mujoco_cfg(MujocoCfg(timestep=0.005)).timestep == 0.005


def test_an_option_written_out_counts_even_at_mujocos_default(kit):
    """MujocoCfg defaults to implicitfast; an XML that says Euler means it."""
    quiet = build(robot=kit.cfg(kit.CART))
    assert quiet.resolve_mujoco_cfg(MujocoCfg()).integrator == "implicitfast"
    spoken = build(robot=kit.cfg(kit.CART, 'integrator="Euler"/>'))
    assert spoken.resolve_mujoco_cfg(MujocoCfg()).integrator == "euler"


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


def test_options_that_the_config_lacks_reach_the_compiled_model(kit, xml):
    scene = build(robot=kit.cfg(xml, 'density="1000" wind="1 2 3" noslip_iterations="4"/>'))
    cfg = scene.resolve_mujoco_cfg(MujocoCfg())
    sim = Simulation(1, SimulationCfg(mujoco=cfg), spec=scene.spec, device="cpu")
    assert sim.mj_model.opt.density == 1000.0
    assert sim.mj_model.opt.wind.tolist() == [1.0, 2.0, 3.0]
    assert sim.mj_model.opt.noslip_iterations == 4


def test_flags_add_up_with_those_of_the_config(kit, xml):
    scene = build(
        robot=kit.cfg(xml, '><flag contact="disable" energy="enable"/></option>'),
        other=kit.cfg(kit.BOX, '><flag limit="disable"/></option>'),
    )
    cfg = scene.resolve_mujoco_cfg(MujocoCfg(disableflags=("gravity",)))
    sim = Simulation(1, SimulationCfg(mujoco=cfg), spec=scene.spec, device="cpu")
    for flag in ("CONTACT", "LIMIT", "GRAVITY"):
        assert sim.mj_model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")
    assert sim.mj_model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY


def test_entities_that_disagree_are_reported_and_neither_wins(kit):
    with pytest.warns(UserWarning, match="not applied") as caught:
        scene = build(
            one=kit.cfg(kit.BOX, 'timestep=".01" density="7" cone="elliptic"/>'),
            two=kit.cfg(kit.CART, 'timestep=".02" density="7" cone="pyramidal"/>'),
        )
    text = str(caught[0].message)
    assert "timestep: 0.01 (one), 0.02 (two)" in text
    assert "cone: elliptic (one), pyramidal (two)" in text
    assert "density" not in text
    assert scene.resolve_mujoco_cfg(MujocoCfg()) == MujocoCfg()
    assert scene.compile().opt.density == 7.0


def test_entities_that_disagree_about_a_flag_keep_their_other_flags(kit):
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


def test_the_scenes_own_edits_win_and_are_reported(kit):
    def spec_fn(spec):
        spec.option.density = 5.0

    with pytest.warns(UserWarning, match="density: 5.0, not 7.0 as robot"):
        scene = build(spec_fn, robot=kit.cfg(kit.BOX, 'density="7" viscosity="1"/>'))
    assert scene.compile().opt.density == 5.0
    assert scene.compile().opt.viscosity == 1.0
    assert set(scene.entity_options) == {"viscosity"}


def test_the_entitys_own_spec_keeps_working_alone(kit):
    """MuJoCo itself would warn about every option it drops; nothing is dropped here."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = build(robot=kit.cfg(kit.CART, 'density="7"/>'))
        scene.spec.to_xml()
        scene.compile()
