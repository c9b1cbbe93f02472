"""Corrections to XML that MuJoCo writes."""

from __future__ import annotations

from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from mjlab.utils.xml import fix_spec_xml, strip_buffer_textures

GEOM = '<worldbody><geom name="g" class="a" size="1"/></worldbody>'


def _defaults(xml: str) -> list[str]:
    root = ElementTree.fromstring(fix_spec_xml(xml))
    return [
        ElementTree.tostring(element, encoding="unicode").replace("\n", "").replace("  ", "")
        for element in root.findall("default")
    ]


def test_empty_defaults_are_removed():
    xml = f'<mujoco><default><default class="b"/></default>{GEOM.replace("a", "main")}</mujoco>'
    assert _defaults(xml) == []


def test_an_empty_class_that_is_used_stays():
    xml = (
        '<mujoco><default><default class="p"><geom group="3"/><default class="a"/></default>'
        f"</default>{GEOM}</mujoco>"
    )
    assert mujoco.MjModel.from_xml_string(fix_spec_xml(xml)).geom("g").group == 3


def test_a_default_nested_in_its_own_class_is_merged():
    xml = (
        '<mujoco><default class="main"><geom group="1" condim="4"/><default class="main">'
        '<geom group="2"/><default class="a"><geom margin="0.5"/></default></default></default>'
        f"{GEOM}</mujoco>"
    )
    geom = mujoco.MjModel.from_xml_string(fix_spec_xml(xml)).geom("g")
    assert (geom.group, geom.condim, geom.margin) == (2, 4, 0.5)


def test_what_attaching_writes_can_be_read_again():
    child = mujoco.MjSpec.from_string(
        '<mujoco><default><geom group="4"/><default class="a"><geom condim="6"/></default>'
        f"</default>{GEOM}</mujoco>"
    )
    parent = mujoco.MjSpec()
    parent.attach(child, prefix="", frame=parent.worldbody.add_frame())
    model = mujoco.MjModel.from_xml_string(fix_spec_xml(parent.to_xml()))
    assert (model.geom("g").group, model.geom("g").condim) == (4, 6)


def test_meshdir_is_set_with_and_without_a_compiler():
    for compiler in ("", '<compiler assetdir="old"/>'):
        root = ElementTree.fromstring(fix_spec_xml(f"<mujoco>{compiler}</mujoco>", "new"))
        attributes = root.find("compiler").attrib  # ty: ignore[unresolved-attribute]
        assert attributes == {"meshdir": "new", "texturedir": "new"}
    assert ElementTree.fromstring(fix_spec_xml("<mujoco/>")).find("compiler") is None


def _with_both_kinds_of_texture() -> mujoco.MjSpec:
    """Return a spec of two geoms, whose textures are made from pixels and drawn by MuJoCo."""
    spec = mujoco.MjSpec()
    pixels = np.full((2, 2, 3), 7, dtype=np.uint8)
    spec.add_texture(
        name="raw", type=mujoco.mjtTexture.mjTEXTURE_2D, width=2, height=2, data=pixels.flatten()
    )
    spec.add_texture(
        name="drawn", builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT, width=2, height=2, nchannel=3
    )
    for name in ("raw", "drawn"):
        material = spec.add_material(name=f"{name}_material")
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
        spec.worldbody.add_geom(name=name, size=[1, 1, 1], material=f"{name}_material")
    return spec


def test_textures_made_from_pixels_go_with_their_materials():
    spec = _with_both_kinds_of_texture()
    strip_buffer_textures(spec)
    assert [texture.name for texture in spec.textures] == ["drawn"]
    assert [material.name for material in spec.materials] == ["drawn_material"]
    assert spec.geom("raw").material == ""
    assert spec.geom("drawn").material == "drawn_material"
    mujoco.MjModel.from_xml_string(spec.to_xml())


@pytest.mark.parametrize("all_raw", [False, True])
def test_textures_made_from_pixels_go_from_a_compiled_spec_too(all_raw):
    spec = _with_both_kinds_of_texture()
    if all_raw:
        # Then no material is left whose id the geoms could still have.
        spec.geom("drawn").material = "raw_material"
        spec.delete(spec.material("drawn_material"))
        spec.delete(spec.texture("drawn"))
    spec.compile()
    written = spec.copy()
    strip_buffer_textures(written)
    model = mujoco.MjModel.from_xml_string(written.to_xml())
    assert [model.geom(i).name for i in range(model.ngeom)] == ["raw", "drawn"]
    assert [model.tex(i).name for i in range(model.ntex)] == ([] if all_raw else ["drawn"])
    looks = [_look(model, name) for name in ("raw", "drawn")]
    plain = ((0.5, 0.5, 0.5, 1.0), False)
    assert looks == [plain, plain if all_raw else ((1.0, 1.0, 1.0, 1.0), True)]


def _look(model: mujoco.MjModel, name: str) -> tuple[tuple[float, ...], bool]:
    """Return a geom's color and whether it has a texture."""
    material = model.geom(name).matid[0]
    if material < 0:
        return tuple(model.geom(name).rgba.tolist()), False
    return tuple(model.mat_rgba[material].tolist()), bool((model.mat_texid[material] >= 0).any())
