"""Masses of a scene: those of each file compiled alone, whatever its `<compiler>` says."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjlab.entity import EntityCfg, VariantEntityCfg
from mjlab.scene import Scene, SceneCfg

from .variant_objects import make_scene, simulate

# Bodies with inferred, visual and explicit masses.
LINKS = """
<mujoco><compiler {settings}/><worldbody>
  <body name="trunk" pos="0 0 1">{joint}
    <geom type="box" size=".1 .2 .3" mass="2"/>
    <geom type="sphere" size=".1" pos=".3 0 0" density="500" group="3"/>
    <body name="light" pos=".5 0 0"><joint axis="0 1 0"/>
      <inertial mass="1e-4" pos="0 0 .1" diaginertia="1e-7 1e-7 {third}"/>
      <geom size=".05"/></body>
    <body name="full" pos="0 0 .5"><joint axis="0 1 0"/>
      <inertial mass=".5" pos="0 0 .1" fullinertia=".01 .02 .025 .001 0 0"/></body>
    <body name="shown" pos="0 .5 0"><joint axis="0 1 0"/>
      <geom size=".05" contype="0" conaffinity="0"/></body>
  </body></worldbody></mujoco>
"""
SETTINGS = [
    "",
    'settotalmass="10"',
    'settotalmass="10" boundmass=".5" boundinertia=".2"',
    'settotalmass="7" inertiafromgeom="true"',
    'settotalmass="7" discardvisual="true"',
    'boundmass=".5"',
    'boundinertia=".01"',
    'inertiafromgeom="true"',
    'inertiagrouprange="0 2"',
    'balanceinertia="true"',
    'discardvisual="true"',
    'alignfree="true"',
]
BODIES = ("trunk", "light", "full", "shown")
FLOATING, HINGED = "<freejoint/>", '<joint axis="0 1 0"/>'


def links(settings: str, joint: str = FLOATING) -> str:
    third = "3e-7" if "balance" in settings else "1.5e-7"
    text = (
        LINKS.replace('<geom size=".05"/></body>', "</body>", 1)
        if "geom" not in settings
        else LINKS
    )
    return text.format(settings=settings, joint=joint, third=third)


def entity(xml: str) -> EntityCfg:
    return EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_string(xml))


@pytest.mark.parametrize("joint", [FLOATING, HINGED])
@pytest.mark.parametrize("settings", SETTINGS)
def test_masses_are_those_of_the_file(settings, joint):
    other = links('settotalmass="3" boundinertia=".3"')
    cfg = SceneCfg(entities={"other": entity(other), "robot": entity(links(settings, joint))})
    model = Scene(cfg, "cpu").compile()
    for name, xml in (("robot", links(settings, joint)), ("other", other)):
        alone = mujoco.MjModel.from_xml_string(xml)
        for body in BODIES:
            for field in ("mass", "inertia", "ipos", "iquat"):
                expected = getattr(alone.body(body), field)
                actual = getattr(model.body(f"{name}/{body}"), field)
                np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-12, err_msg=field)


def test_total_mass_of_one_body():
    xml = (
        '<mujoco><compiler settotalmass="10"/><worldbody><body name="a"><freejoint/>'
        '<geom size=".1" mass="2"/></body></worldbody></mujoco>'
    )
    model = Scene(SceneCfg(entities={"r": entity(xml)}), "cpu").compile()
    assert model.body("r/a").mass == pytest.approx(10.0)


def test_total_mass_of_each_variant():
    def variant(total: float):
        xml = (
            f'<mujoco><compiler settotalmass="{total}"/><worldbody><body name="a"><freejoint/>'
            '<geom size=".1" mass="2"/></body></worldbody></mujoco>'
        )
        return lambda: mujoco.MjSpec.from_string(xml)

    cfg = VariantEntityCfg(variants={"light": variant(4.0), "heavy": variant(6.0)})
    sim = simulate(make_scene(2, {"r": cfg}))
    body = sim.mj_model.body("r/a").id
    np.testing.assert_allclose(sim.model.body_mass[:, body].numpy(), [4.0, 6.0], rtol=1e-6)
    ratio = sim.model.body_inertia[1, body] / sim.model.body_inertia[0, body]
    np.testing.assert_allclose(ratio.numpy(), 1.5, rtol=1e-5)
