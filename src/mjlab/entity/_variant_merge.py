"""Making one spec that has room for every variant of an entity."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import mujoco

from mjlab.entity._variant_slots import MESH, Shared, Slot
from mjlab.utils.spec import (
    compile_composed,
    copy_material_data,
    copy_mesh_data,
    copy_texture_data,
    make_asset_paths_absolute,
    put_files_in_memory,
)

# What belongs to a geom's place in its spec, or is set anew.
_NOT_COPIED = {"name", "id", "signature", "classname", "compiler", "info", "parent", "frame"}
_NOT_COPIED |= {"meshname", "hfieldname", "material", "mass", "plugin", "userdata"}

_COPY = {
    "textures": copy_texture_data,
    "materials": copy_material_data,
    "meshes": copy_mesh_data,
}
_ADD = {"textures": "add_texture", "materials": "add_material", "meshes": "add_mesh"}

Assets = dict[str, list[list[Any]]]
"""By kind, for each variant, the elements of the merged spec in the order of the variant's own."""


def merge_specs(
    names: list[str],
    specs: list[mujoco.MjSpec],
    bodies: list[list[mujoco.MjsBody]],
    slots: list[list[Slot]],
) -> tuple[Assets, list[list[mujoco.MjsGeom]]]:
    """Turn the first of `specs`, in place, into one with the slots and the assets of all.

    Args:
        names: Names of the variants.
        specs: Their specs.
        bodies: For each path, the body of each variant.
        slots: For each path, the slots of its body.

    Returns:
        The merged assets, and for each path the geoms of the slots.
    """
    merged = specs[0]
    any_in_memory = any(spec.assets for spec in specs)
    for name, spec in zip(names, specs, strict=True):
        _name_after_files(spec)
        make_asset_paths_absolute(spec)
        if any_in_memory:
            put_files_in_memory(spec, f"{name}_")
    assets = _merge_assets(names, specs)
    geoms = [
        [_slot_geom(names, group[0], slot) for slot in own]
        for group, own in zip(bodies, slots, strict=True)
    ]
    _make_hulls(merged, assets, slots, specs)
    return assets, geoms


def refuse_references(
    name: str, spec: mujoco.MjSpec, slots: list[Slot], shared: list[Shared], k: int
) -> None:
    """Check that nothing in the spec of variant `k` names a geom that becomes part of a slot.

    Raises:
        ValueError: a sensor, contact pair or tendon does.
    """
    own = [geom.name for slot in slots if (geom := slot.geoms[k]) is not None and geom.name]
    geom_type = mujoco.mjtObj.mjOBJ_GEOM
    used = [
        (f"sensor {s.name!r}", target)
        for s in spec.sensors
        for target, kind in ((s.objname, s.objtype), (s.refname, s.reftype))
        if kind == geom_type
    ]
    used += [
        (f"contact pair {p.name!r}", g) for p in spec.pairs for g in (p.geomname1, p.geomname2)
    ]
    used += [
        (f"tendon {tendon.name!r}", wrap.target.name)
        for tendon in spec.tendons
        for wrap in tendon.path
        if wrap.type in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    ]
    for what, target in used:
        if target in own:
            raise ValueError(
                f"The {what} of variant {name!r} refers to the geom {target!r}, which its siblings "
                "do not share: meshes, and primitives of another type, are put together under "
                "other names. Refer to its body or to a site instead, or give all variants that "
                "geom as a primitive of the same name and type."
            )


def _name_after_files(spec: mujoco.MjSpec) -> None:
    """Give assets the names that the compiler would give them, so that they can be renamed."""
    for asset in (*spec.meshes, *spec.textures):
        if not asset.name and asset.file:
            asset.name = PurePosixPath(asset.file).stem


def _merge_assets(names: list[str], specs: list[mujoco.MjSpec]) -> Assets:
    """Bring all meshes, materials and textures into the first spec, as `<variant>/<name>`."""
    merged = specs[0]
    files = dict(merged.assets)
    _rename_own(merged, f"{names[0]}/")
    assets: Assets = {kind: [list(getattr(merged, kind))] for kind in _COPY}
    for name, spec in zip(names[1:], specs[1:], strict=True):
        for kind, copy in _COPY.items():
            own = []
            for source in getattr(spec, kind):
                target = getattr(merged, _ADD[kind])(name=f"{name}/{source.name}")
                copy(source, target)
                own.append(target)
            assets[kind].append(own)
        _prefix_references(name, assets, len(assets["meshes"]) - 1)
        files |= spec.assets
    merged.assets = files
    return assets


def _rename_own(spec: mujoco.MjSpec, prefix: str) -> None:
    """Rename the assets of a spec, and all references to them."""
    for kind in _COPY:
        for asset in list(getattr(spec, kind)):
            if kind == "materials":
                # Once compiled, a material keeps the names of its textures, so it is replaced.
                renamed = spec.add_material(name=prefix + asset.name)
                copy_material_data(asset, renamed)
                renamed.textures = [prefix + name if name else name for name in asset.textures]
                spec.delete(asset)
            else:
                asset.name = prefix + asset.name
    for user in (*spec.geoms, *spec.sites, *spec.tendons, *spec.skins, *spec.flexes, *spec.meshes):
        if user.material:
            user.material = prefix + user.material
    for geom in spec.geoms:
        if geom.meshname:
            geom.meshname = prefix + geom.meshname


def _prefix_references(name: str, assets: Assets, k: int) -> None:
    for material in assets["materials"][k]:
        material.textures = [f"{name}/{own}" if own else own for own in material.textures]
    for mesh in assets["meshes"][k]:
        if mesh.material:
            mesh.material = f"{name}/{mesh.material}"


def _slot_geom(names: list[str], body: mujoco.MjsBody, slot: Slot) -> mujoco.MjsGeom:
    """Return the geom of a slot: that of the first variant, renamed, or a new one without mass."""
    own = slot.geoms[0]
    if own is not None:
        own.name = slot.key.name
        return own
    k, source = next((k, geom) for k, geom in enumerate(slot.geoms) if geom is not None)
    geom = body.add_geom(name=slot.key.name)
    for field in dir(source):
        if field.startswith("_") or field in _NOT_COPIED or callable(getattr(source, field)):
            continue
        setattr(geom, field, getattr(source, field))
    geom.mass = 0.0
    for field in ("meshname", "material"):
        name = getattr(source, field)
        setattr(geom, field, f"{names[k]}/{name}" if name else "")
    return geom


def _make_hulls(
    merged: mujoco.MjSpec, assets: Assets, slots: list[list[Slot]], specs: list[mujoco.MjSpec]
) -> None:
    """Have the compiler make the convex hull of every mesh that can touch something.

    It makes one only for meshes that a colliding geom uses, and the merged spec uses but one mesh
    in each slot. Once made it stays with the mesh, also after the geom is gone.
    """
    needed: dict[str, None] = {}
    for own in slots:
        for slot in own:
            if slot.key.role != "collision" or slot.kind[0] != MESH:
                continue
            for k, geom in enumerate(slot.geoms):
                if geom is not None and k > 0:
                    names = [mesh.name for mesh in specs[k].meshes]
                    needed[assets["meshes"][k][names.index(geom.meshname)].name] = None
    users = [
        merged.worldbody.add_geom(type=MESH, meshname=name, contype=1, conaffinity=1, mass=0.0)
        for name in needed
    ]
    if users:
        compile_composed(merged)
    for user in users:
        merged.delete(user)
