"""Merging variants of an entity into one spec: what they must share, slots, assets.

The merged spec has a geom, a slot, for as many geoms as the richest variant has. A slot holds one
geom of each variant or none. What is compiled once for all environments (type, collision masks,
condim, priority, group) is a slot's own, so that only geoms alike in these share one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Literal

import mujoco

from mjlab.utils.mujoco import control_inputs
from mjlab.utils.spec import (
    compile_composed,
    copy_material_data,
    copy_mesh_data,
    copy_texture_data,
    make_asset_paths_absolute,
    put_files_in_memory,
)

GeomRole = Literal["visual", "collision"]
RESERVED_NAME_PREFIXES = ("mjlab/pad/",)
"""Beginnings of names that merging variants gives to geoms; specs must not use them."""
MESH = mujoco.mjtGeom.mjGEOM_MESH
_UNSUPPORTED = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_HFIELD: "height field",
    mujoco.mjtGeom.mjGEOM_SDF: "signed distance field",
}

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


# What variants must have in common.


@dataclass(frozen=True)
class JointSignature:
    """A joint, as far as variants have to agree on it."""

    name: str
    """Its name."""
    type: int
    """`mjtJoint`."""
    qpos_width: int
    """Number of its positions."""
    qvel_width: int
    """Number of its velocities."""


@dataclass(frozen=True)
class GeomSignature:
    """A geom that is no mesh."""

    name: str | None
    """Its name, if it has one."""
    type: int
    """`mjtGeom`."""
    role: GeomRole
    """Whether it can touch anything."""


@dataclass(frozen=True)
class BodySignature:
    """A body with all below it."""

    path: str
    """Names from the root down, each after a slash."""
    name: str
    """Its name."""
    joints: tuple[JointSignature, ...]
    """Its joints, in order."""
    geoms: tuple[GeomSignature, ...]
    """Its geoms that are no meshes, in order. Variants may differ in them."""
    children: tuple[BodySignature, ...]
    """The bodies attached to it, in order."""


def validate_variant_specs(names: list[str], specs: list[mujoco.MjSpec]) -> None:
    """Check that specs can be variants of one entity: they may differ in geoms and in figures.

    Raises:
        ValueError: a spec does not have exactly one top-level body with a free joint first; uses a
            reserved name; or differs from the first one in bodies, joints, kinds of inertial,
            sites, cameras, lights, actuators, sensors, tendons or equalities.
    """
    for name, spec in zip(names, specs, strict=True):
        _check_variant(name, spec)
    first = _structure(specs[0])
    for name, spec in zip(names[1:], specs[1:], strict=True):
        own = _structure(spec)
        for kind, expected in first.items():
            if own[kind] != expected:
                raise ValueError(_difference(kind, names[0], expected, name, own[kind]))


def _check_variant(name: str, spec: mujoco.MjSpec) -> None:
    """Raise `ValueError` unless a spec floats as one tree, without reserved names."""
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ValueError(
            f"Variant {name!r} has {len(roots)} top-level bodies ({[b.name for b in roots]}); it "
            "must have exactly one. Put the others below it, or make them entities of their own."
        )
    joints = list(roots[0].joints)
    if not joints or joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(
            f"The top-level body {roots[0].name!r} of variant {name!r} has no free joint as its "
            "first joint. Variants must float: add <freejoint/> to it."
        )
    if list(spec.worldbody.geoms) or list(spec.worldbody.sites):
        raise ValueError(
            f"Variant {name!r} has geoms or sites in its world body, which belong to no variant. "
            f"Put them into the body {roots[0].name!r}."
        )
    used = [
        element.name
        for kind in ("bodies", "geoms", "meshes", "materials", "textures")
        for element in getattr(spec, kind)
        if element.name.startswith(RESERVED_NAME_PREFIXES)
    ]
    if used:
        raise ValueError(
            f"Variant {name!r} uses the names {used}. Names that begin with "
            f"{RESERVED_NAME_PREFIXES[0]!r} are reserved for merged variants: rename them."
        )


def _structure(spec: mujoco.MjSpec) -> dict[str, list[Any]]:
    """Return by kind of element what must be the same in all variants."""
    bodies = list(walk_bodies(spec))

    def of_bodies(describe: Callable[[mujoco.MjsBody], Any]) -> list[Any]:
        return [(path, describe(body)) for path, body in bodies]

    return {
        "bodies": [path for path, _ in bodies],
        "joints": of_bodies(lambda b: [(j.name, j.type.name) for j in b.joints]),
        "kinds of inertial": of_bodies(_inertial_kind),
        "sites": of_bodies(lambda b: [site.name for site in b.sites]),
        "cameras": of_bodies(lambda b: [camera.name for camera in b.cameras]),
        "lights": of_bodies(lambda b: [light.name for light in b.lights]),
        "actuators": [
            (a.name, a.trntype.name, a.target, len(control_inputs(a))) for a in spec.actuators
        ],
        "sensors": [(s.name, s.type.name, s.objname) for s in spec.sensors],
        "tendons": [tendon.name for tendon in spec.tendons],
        "equalities": [(e.name, e.type.name, e.name1, e.name2) for e in spec.equalities],
        "contact pairs": [(p.name, p.geomname1, p.geomname2) for p in spec.pairs],
        "contact exclusions": [(e.bodyname1, e.bodyname2) for e in spec.excludes],
        "flexes": [flex.name for flex in spec.flexes],
        "skins": [skin.name for skin in spec.skins],
    }


def _inertial_kind(body: mujoco.MjsBody) -> str:
    if not body.explicitinertial:
        return "derived from geoms"
    is_full = body.fullinertia[0] == body.fullinertia[0]
    return "fullinertia" if is_full else "diaginertia"


def _difference(kind: str, first: str, expected: list[Any], name: str, found: list[Any]) -> str:
    """Return a message that names the first entries that are not the same."""
    missing = [entry for entry in expected if entry not in found]
    extra = [entry for entry in found if entry not in expected]
    if missing or extra:
        detail = f"{name!r} has {_shown(extra)} where {first!r} has {_shown(missing)}"
    else:
        detail = f"{name!r} has them in the order {_shown(found)}, {first!r} {_shown(expected)}"
    return (
        f"The variants {first!r} and {name!r} have other {kind}: {detail}. Variants of an entity "
        f"may differ in geoms and figures alone. Give {name!r} the same {kind} as {first!r}, names "
        "and order included, or make it an entity of its own."
    )


def _shown(entries: list[Any], most: int = 4) -> str:
    texts = [
        f"{entry[0]}: {entry[1]}"
        if isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[1], list | str)
        else str(entry)
        for entry in entries[:most]
    ]
    if len(entries) > most:
        texts.append(f"... and {len(entries) - most} more")
    return ", ".join(texts) if texts else "nothing"


# Slots: geoms that variants do not share.


@dataclass(frozen=True, order=True)
class SlotKey:
    """Where a slot is."""

    body_path: str
    """Path of the body."""
    role: GeomRole
    """Whether its geoms can touch anything."""
    ordinal: int
    """Number among the slots of that body and role."""

    @property
    def name(self) -> str:
        """Name of the geom in the merged spec."""
        return f"{RESERVED_NAME_PREFIXES[0].rstrip('/')}{self.body_path}/{self.role}/{self.ordinal}"


@dataclass(frozen=True)
class VariantGeomSpec:
    """A geom of a variant, as its spec has it after the entity's editors."""

    mesh_name: str
    """Its mesh, by the name in the variant's own spec; empty for a primitive."""
    geom_name: str | None
    """Its name in the variant's own spec."""
    contype: int
    conaffinity: int
    condim: int
    group: int
    priority: int
    material: str | None
    """Its material, by the name in the variant's own spec."""
    rgba: tuple[float, float, float, float]
    friction: tuple[float, float, float]
    margin: float
    gap: float
    solref: tuple[float, float]
    solimp: tuple[float, float, float, float, float]
    mass: float
    """Kilograms; NaN where the density counts."""
    density: float

    @classmethod
    def of(cls, geom: mujoco.MjsGeom) -> VariantGeomSpec:
        """Read it from a spec's geom."""
        return cls(
            mesh_name=geom.meshname,
            geom_name=geom.name or None,
            contype=int(geom.contype),
            conaffinity=int(geom.conaffinity),
            condim=int(geom.condim),
            group=int(geom.group),
            priority=int(geom.priority),
            material=geom.material or None,
            rgba=_floats(geom.rgba),
            friction=_floats(geom.friction),
            margin=float(geom.margin),
            gap=float(geom.gap),
            solref=_floats(geom.solref),
            solimp=_floats(geom.solimp),
            mass=float(geom.mass),
            density=float(geom.density),
        )


@dataclass(frozen=True)
class VariantSlot:
    """A geom of the merged spec that holds another geom of each variant, or none."""

    key: SlotKey
    """Where it is."""
    template_geom_name: str
    """Its name in the merged spec."""
    source_geom_names: tuple[str | None, ...]
    """For each variant the name of its geom; None for no name, or no geom."""


@dataclass
class Slot:
    """A slot while variants are merged."""

    key: SlotKey
    kind: tuple[int, ...]
    """What its geoms have in common; see `geom_kind`."""
    geoms: list[mujoco.MjsGeom | None]
    """The geom of each variant."""


Shared = tuple[mujoco.MjsGeom, ...]
"""One geom that all variants have, as each of them has it."""


def split_geoms(
    path: str, bodies: list[mujoco.MjsBody], names: list[str]
) -> tuple[list[Shared], list[Slot]]:
    """Sort the geoms of one body of each variant into shared ones and slots.

    A geom that is no mesh is shared if every variant has one of that name and kind, or, without
    names, if all variants have the same kinds in the same order. It keeps its name.

    Raises:
        ValueError: a geom that would need a slot is of a type that cannot have one.
    """
    geoms = [list(body.geoms) for body in bodies]
    shared = _shared_geoms(geoms)
    taken = [{group[k].id for group in shared} for k in range(len(bodies))]
    slots: dict[tuple[GeomRole, tuple[int, ...]], list[Slot]] = {}
    counts: Counter[GeomRole] = Counter()
    for k, own in enumerate(geoms):
        used: Counter[tuple[GeomRole, tuple[int, ...]]] = Counter()
        for geom in own:
            if geom.id in taken[k]:
                continue
            unsupported = _UNSUPPORTED.get(geom.type) or ("plugin" if geom.plugin.active else None)
            if unsupported is not None:
                raise ValueError(
                    f"Variant {names[k]!r} has the {unsupported} geom {geom.name!r} in the body "
                    f"{path!r}, which its siblings do not have. Variants may differ in meshes and "
                    "primitives alone: give all of them that geom, by the same name, or none."
                )
            role, kind = geom_role(geom), geom_kind(geom)
            place = slots.setdefault((role, kind), [])
            if used[role, kind] == len(place):
                key = SlotKey(path, role, counts[role])
                place.append(Slot(key, kind, [None] * len(bodies)))
                counts[role] += 1
            place[used[role, kind]].geoms[k] = geom
            used[role, kind] += 1
    return shared, [slot for group in slots.values() for slot in group]


def _shared_geoms(geoms: list[list[mujoco.MjsGeom]]) -> list[Shared]:
    primitives = [[geom for geom in own if geom.type != MESH] for own in geoms]
    shared: list[Shared] = []
    for geom in primitives[0]:
        group = [
            next((g for g in own if g.name == geom.name and geom_kind(g) == geom_kind(geom)), None)
            for own in primitives
        ]
        if geom.name and all(group):
            shared.append(tuple(g for g in group if g is not None))
    unnamed = [[geom for geom in own if not geom.name] for own in primitives]
    kinds = [[geom_kind(geom) for geom in own] for own in unnamed]
    if all(own == kinds[0] for own in kinds):
        shared += list(zip(*unnamed, strict=True))
    return shared


def geom_kind(geom: mujoco.MjsGeom) -> tuple[int, ...]:
    """Return what of a geom cannot differ between environments on every engine."""
    return tuple(
        int(getattr(geom, name))
        for name in ("type", "contype", "conaffinity", "condim", "priority", "group")
    )


def geom_role(geom: mujoco.MjsGeom) -> GeomRole:
    """Return `visual` for a geom that can touch nothing, else `collision`."""
    return "collision" if geom.contype or geom.conaffinity else "visual"


def walk_bodies(spec: mujoco.MjSpec) -> Iterator[tuple[str, mujoco.MjsBody]]:
    """Yield the path and the body of each body but the world, parents first."""

    def below(parent: mujoco.MjsBody, path: str) -> Iterator[tuple[str, mujoco.MjsBody]]:
        for index, body in enumerate(parent.bodies):
            own = f"{path}/{body.name or f'body{index}'}"
            yield own, body
            yield from below(body, own)

    yield from below(spec.worldbody, "")


def check_references(
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


# The merged spec.


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
        # The names that the compiler would give them, so that they can be renamed.
        for asset in (*spec.meshes, *spec.textures):
            if not asset.name and asset.file:
                asset.name = PurePosixPath(asset.file).stem
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
        for material in assets["materials"][-1]:
            material.textures = [f"{name}/{own}" if own else own for own in material.textures]
        for mesh in assets["meshes"][-1]:
            if mesh.material:
                mesh.material = f"{name}/{mesh.material}"
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


def _floats(values: Iterable[float]) -> Any:
    return tuple(float(value) for value in values)
