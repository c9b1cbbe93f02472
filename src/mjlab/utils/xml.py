"""Corrections to the XML that MuJoCo writes for a spec."""

from __future__ import annotations

from xml.etree import ElementTree

import mujoco

_RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_STAND_IN = "mjlab_without_texture"


def fix_spec_xml(xml: str, meshdir: str | None = None) -> str:
    """Return the XML that `MjSpec.to_xml` wrote, corrected so that MuJoCo reads it again.

    Empty `<default>` elements are removed, and a default nested in a default of the same class is
    merged into it: both are left behind by attaching specs. `meshdir`, if given, is set as the
    folder of meshes and textures.
    """
    root = ElementTree.fromstring(xml)
    used = {
        element.get(key)
        for element in root.iter()
        for key in ("class", "childclass")
        if element.tag != "default"
    }
    for default in root.findall("default"):
        _clean_default(default, used)
        if len(default) == 0:
            root.remove(default)
    if meshdir is not None:
        compiler = root.find("compiler")
        if compiler is None:
            compiler = ElementTree.Element("compiler")
            root.insert(0, compiler)
        compiler.attrib.pop("assetdir", None)
        compiler.set("meshdir", meshdir)
        compiler.set("texturedir", meshdir)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def _clean_default(default: ElementTree.Element, used: set[str | None]) -> None:
    # The outermost default is the class "main" where no name is written.
    name = default.get("class", "main")
    for child in default.findall("default"):
        _clean_default(child, used)
        inner = child.get("class", "main")
        if inner == name:
            default.remove(child)
            _merge_default(default, child)
        elif len(child) == 0 and inner not in used:
            # An empty class that something refers to has to stay: it inherits.
            default.remove(child)


def _merge_default(outer: ElementTree.Element, inner: ElementTree.Element) -> None:
    """Move what `inner` sets into `outer`; where both set an attribute, the inner value counts."""
    for element in inner:
        same = None if element.tag == "default" else outer.find(element.tag)
        if same is None:
            outer.append(element)
        else:
            same.attrib.update(element.attrib)


def strip_buffer_textures(spec: mujoco.MjSpec) -> None:
    """Delete what uses textures made from raw pixels, which XML cannot express.

    Removes those textures, the materials whose RGB texture they are, and the references of geoms
    to these materials. Changes `spec`.

    Where MuJoCo will not let go of a reference, those geoms get a material without a texture that
    looks like none.
    """
    textures = {t.name: t for t in spec.textures if _has_only_pixels(t)}
    materials = {m.name: m for m in spec.materials if m.textures[_RGB_ROLE] in textures}
    geoms = [geom for geom in spec.geoms if geom.material in materials]
    for geom in geoms:
        geom.material = ""
    for element in (*materials.values(), *textures.values()):
        spec.delete(element)
    if geoms and not _can_be_written(spec):
        # Once compiled, a geom keeps the id of its material, and no material's name at all does not
        # reset it, so that the id may now be out of bounds. Another name does.
        if spec.material(_STAND_IN) is None:
            spec.add_material(name=_STAND_IN, rgba=(0.5, 0.5, 0.5, 1.0))
        for geom in geoms:
            geom.material = _STAND_IN


def _can_be_written(spec: mujoco.MjSpec) -> bool:
    try:
        spec.to_xml()
    except ValueError:
        # What is wrong beyond the materials is told when the spec is written.
        return False
    return True


def _has_only_pixels(texture: mujoco.MjsTexture) -> bool:
    has_source = (
        texture.file
        or any(texture.cubefiles)
        or texture.builtin != mujoco.mjtBuiltin.mjBUILTIN_NONE
    )
    return not has_source and len(texture.data) > 0
