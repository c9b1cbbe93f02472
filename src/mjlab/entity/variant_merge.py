"""Variant merging: structure checks, slots and assets of the merged spec.

A slot is a geom of the merged spec that holds at most one geom of each variant. Attributes that are
compiled once for all environments (type, contype, conaffinity, condim, priority, group) belong to
the slot, so geoms share a slot only if they agree in these.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from itertools import chain
from pathlib import PurePosixPath
from typing import Any, Literal

import mujoco
import numpy as np

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
"""Prefixes of geom names in merged specs. Users' specs must not use them."""
OPTIONAL_KINDS = ("sites", "cameras", "lights")
"""Kinds of elements that variants should share by name, but need not."""
MESH = mujoco.mjtGeom.mjGEOM_MESH
_UNSUPPORTED = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_HFIELD: "height field",
    mujoco.mjtGeom.mjGEOM_SDF: "signed distance field",
}

# Attributes that belong to a geom's place in its spec, or are set separately.
_NOT_COPIED = {"name", "id", "signature", "classname", "compiler", "info", "parent", "frame"}
_NOT_COPIED |= {"meshname", "hfieldname", "material", "mass", "plugin", "userdata"}
_COPY = {
    "textures": copy_texture_data,
    "materials": copy_material_data,
    "meshes": copy_mesh_data,
}
_ADD = {"textures": "add_texture", "materials": "add_material", "meshes": "add_mesh"}
Assets = dict[str, list[list[Any]]]
"""Elements of the merged spec in the order of each variant's spec, by kind and variant."""


# Structure that variants must share.


@dataclass(frozen=True)
class JointSignature:
    """Joint properties that all variants must share."""

    name: str
    """Its name."""
    type: int
    """`mjtJoint`."""
    qpos_width: int
    """Number of positions."""
    qvel_width: int
    """Number of velocities."""


@dataclass(frozen=True)
class GeomSignature:
    """Non-mesh geom."""

    name: str | None
    """Name; None for an unnamed geom."""
    type: int
    """`mjtGeom`."""
    role: GeomRole
    """Collision or visual geom."""


@dataclass(frozen=True)
class BodySignature:
    """Body with its descendants."""

    path: str
    """Names from the root down, each preceded by a slash."""
    name: str
    """Its name."""
    joints: tuple[JointSignature, ...]
    """Joints, in order."""
    geoms: tuple[GeomSignature, ...]
    """Non-mesh geoms, in order. Variants may differ in these."""
    children: tuple[BodySignature, ...]
    """Child bodies, in order."""


def validate_variant_specs(names: list[str], specs: list[mujoco.MjSpec]) -> None:
    """Check that specs can be variants of one entity: they may differ in geoms and parameters.

    Raises:
        ValueError: a spec does not have exactly one top-level body with a free joint first, or differs from the first spec in bodies, joints, kinds of inertial,
            actuators, sensors, tendons or equalities. Differing sites, cameras and lights are a
            warning: the scene has those of the first spec.
    """
    for name, spec in zip(names, specs, strict=True):
        _check_variant(name, spec)
    first = _structure(specs[0])
    for name, spec in zip(names[1:], specs[1:], strict=True):
        own = _structure(spec)
        for kind, expected in first.items():
            if own[kind] != expected and kind in OPTIONAL_KINDS:
                warnings.warn(
                    f"Variants {names[0]!r} and {name!r} have different {kind}: {name!r} has "
                    f"{_differing(own[kind], expected)}; all environments have the {kind} of "
                    f"{names[0]!r}.",
                    UserWarning,
                    stacklevel=2,
                )
            elif own[kind] != expected:
                raise ValueError(
                    f"Variants {names[0]!r} and {name!r}: expected the same {kind}, by name and order, "
                    f"got a difference: {name!r} has {_differing(own[kind], expected)}, {names[0]!r} has "
                    f"{_differing(expected, own[kind])}. Variants may differ only in geoms and model "
                    f"parameters; make {name!r} a separate entity if the difference is intended."
                )


def _check_variant(name: str, spec: mujoco.MjSpec) -> None:
    """Raise `ValueError` unless a spec is one floating tree."""
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ValueError(
            f"Variant {name!r}: expected exactly one top-level body, got {len(roots)} "
            f"({[b.name for b in roots]}); make the others its children, or separate entities."
        )
    joints = list(roots[0].joints)
    if not joints or joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(
            f"Variant {name!r}: expected a free joint as first joint of the top-level body "
            f"{roots[0].name!r}; add <freejoint/> to it."
        )
    if list(spec.worldbody.geoms) or list(spec.worldbody.sites):
        raise ValueError(
            f"Variant {name!r}: geoms and sites in the world body are not supported; move them to the "
            f"body {roots[0].name!r}."
        )


def _structure(spec: mujoco.MjSpec) -> dict[str, list[Any]]:
    """Return the structure that all variants must share, by kind of element."""
    bodies = list(walk_bodies(spec))

    def of_bodies(describe: Callable[[mujoco.MjsBody], Any]) -> list[Any]:
        return [(path, describe(body)) for path, body in bodies]

    return {
        "bodies": [path for path, _ in bodies],
        "joints": of_bodies(lambda b: [(j.name, j.type.name) for j in b.joints]),
        "kinds of inertial": of_bodies(_inertial_kind),
        **{
            kind: of_bodies(lambda b, kind=kind: [element.name for element in getattr(b, kind)])
            for kind in OPTIONAL_KINDS
        },
        "actuators": [
            (a.name, a.trntype.name, a.target, len(control_inputs(a))) for a in spec.actuators
        ],
        "sensors": [(s.name, s.type.name, s.objname) for s in spec.sensors],
        "equalities": [(e.name, e.type.name, e.name1, e.name2) for e in spec.equalities],
        "contact pairs": [(p.name, p.geomname1, p.geomname2) for p in spec.pairs],
        "contact exclusions": [(e.bodyname1, e.bodyname2) for e in spec.excludes],
        **{
            kind: [element.name for element in getattr(spec, kind)]
            for kind in ("tendons", "flexes", "skins")
        },
    }


def _inertial_kind(body: mujoco.MjsBody) -> str:
    if not body.explicitinertial:
        return "derived from geoms"
    is_full = body.fullinertia[0] == body.fullinertia[0]
    return "fullinertia" if is_full else "diaginertia"


def _differing(own: list[Any], others: list[Any], most: int = 4) -> str:
    """Return the first entries of `own` that are not in `others`; all if only the order differs."""
    entries = [entry for entry in own if entry not in others]
    if not entries and all(entry in own for entry in others):
        entries = own
    texts = [
        f"{entry[0]}: {entry[1]}"
        if isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[1], list | str)
        else str(entry)
        for entry in entries[:most]
    ]
    if len(entries) > most:
        texts.append(f"... and {len(entries) - most} more")
    return ", ".join(texts) if texts else "nothing"


# Slots: geoms that are not shared by all variants.


@dataclass(frozen=True, order=True)
class SlotKey:
    """Identifier of a slot."""

    body_path: str
    """Path of the body."""
    role: GeomRole
    """Role of its geoms."""
    ordinal: int
    """Index among the slots of the same body and role."""

    @property
    def name(self) -> str:
        """Name of the geom in the merged spec."""
        return f"{RESERVED_NAME_PREFIXES[0].rstrip('/')}{self.body_path}/{self.role}/{self.ordinal}"


@dataclass(frozen=True)
class VariantGeomSpec:
    """Geom of a variant, after the entity's editors."""

    mesh_name: str
    """Mesh name in the variant's spec; empty for a primitive."""
    geom_name: str | None
    """Name in the variant's spec."""
    contype: int
    conaffinity: int
    condim: int
    group: int
    priority: int
    material: str | None
    """Material name in the variant's spec."""
    rgba: tuple[float, float, float, float]
    friction: tuple[float, float, float]
    margin: float
    gap: float
    solref: tuple[float, float]
    solimp: tuple[float, float, float, float, float]
    mass: float
    """Mass (kg); NaN if the mass is computed from the density."""
    density: float

    @classmethod
    def of(cls, geom: mujoco.MjsGeom) -> VariantGeomSpec:
        """Return the attributes of a spec geom."""
        names = [
            f.name for f in fields(cls) if f.name not in ("mesh_name", "geom_name", "material")
        ]
        values: dict[str, Any] = {}
        for name in names:
            value = np.asarray(getattr(geom, name)).tolist()
            values[name] = tuple(value) if isinstance(value, list) else value
        return cls(
            mesh_name=geom.meshname,
            geom_name=geom.name or None,
            material=geom.material or None,
            **values,
        )


@dataclass(frozen=True)
class VariantSlot:
    """Geom of the merged spec that holds at most one geom of each variant."""

    key: SlotKey
    """Identifier."""
    template_geom_name: str
    """Name in the merged spec."""
    source_geom_names: tuple[str | None, ...]
    """Geom name per variant. None: unnamed or absent geom."""


@dataclass
class Slot:
    """Slot during merging."""

    key: SlotKey
    kind: tuple[int, ...]
    """Attributes shared by its geoms; see `geom_kind`."""
    geoms: list[mujoco.MjsGeom | None]
    """Geom of each variant."""

    @property
    def common_name(self) -> str | None:
        """Name of its geoms, if all variants have one by this name."""
        names = {None if geom is None else geom.name for geom in self.geoms}
        return names.pop() if len(names) == 1 else None


Shared = tuple[mujoco.MjsGeom, ...]
"""Geom shared by all variants, one element per variant."""


def split_geoms(
    path: str, bodies: list[mujoco.MjsBody], names: list[str]
) -> tuple[list[Shared], list[Slot]]:
    """Sort the geoms of one body of each variant into shared ones and slots.

    A non-mesh geom is shared if every variant has a geom with the same name and kind. Unnamed
    geoms are shared if all variants have the same kinds in the same order. Shared geoms keep their
    names.

    Raises:
        ValueError: a geom that needs a slot is of an unsupported type.
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
                    f"Variant {names[k]!r}: {unsupported} geom {geom.name!r} of body {path!r} is "
                    "missing in other variants. Variants may differ only in meshes and primitives; "
                    "add the geom to all variants, with the same name, or remove it."
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
    """Return the attributes of a geom that some engines cannot vary between environments."""
    return tuple(
        int(getattr(geom, name))
        for name in ("type", "contype", "conaffinity", "condim", "priority", "group")
    )


def geom_role(geom: mujoco.MjsGeom) -> GeomRole:
    """Return `visual` for a geom that cannot collide, else `collision`."""
    return "collision" if geom.contype or geom.conaffinity else "visual"


def walk_bodies(spec: mujoco.MjSpec) -> Iterator[tuple[str, mujoco.MjsBody]]:
    """Yield (path, body) for each body except the world, parents first."""

    def below(parent: mujoco.MjsBody, path: str) -> Iterator[tuple[str, mujoco.MjsBody]]:
        for index, body in enumerate(parent.bodies):
            own = f"{path}/{body.name or f'body{index}'}"
            yield own, body
            yield from below(body, own)

    yield from below(spec.worldbody, "")


def check_references(
    name: str, spec: mujoco.MjSpec, slots: list[Slot], shared: list[Shared], k: int
) -> None:
    """Check that elements of variant `k` refer to geoms that the merged spec has by one name.

    Raises:
        ValueError: a sensor or contact pair refers to a geom of a slot with other names in other
            variants, or a tendon to a geom of any slot.
    """
    geoms = {geom.name: slot for slot in slots if (geom := slot.geoms[k]) is not None and geom.name}
    own = [name for name, slot in geoms.items() if slot.common_name != name]
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
    used = [(user, target) for user, target in used if target in own]
    used += [
        (f"tendon {tendon.name!r}", wrap.target.name)
        for tendon in spec.tendons
        for wrap in tendon.path
        if wrap.type in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    ]
    for user, target in used:
        if target in geoms:
            raise ValueError(
                f"Variant {name!r}: {user} refers to geom {target!r}, but only geoms shared by all "
                "variants keep their names when variants are merged; refer to its body or a site, "
                "or add a primitive of the same name and type to all variants."
            )


# Merged spec.


def merge_specs(
    names: list[str],
    specs: list[mujoco.MjSpec],
    bodies: list[list[mujoco.MjsBody]],
    slots: list[list[Slot]],
) -> tuple[Assets, list[list[mujoco.MjsGeom]]]:
    """Merge the slots and assets of all `specs` into the first one, in place.

    Args:
        names: Names of the variants.
        specs: Specs of the variants.
        bodies: Body of each variant, by path.
        slots: Slots of each path's body.

    Returns:
        The merged assets, and the slot geoms of each path.
    """
    merged = specs[0]
    any_in_memory = any(spec.assets for spec in specs)
    for name, spec in zip(names, specs, strict=True):
        # Assign the names that the compiler would assign, so that assets can be renamed.
        for asset in (*spec.meshes, *spec.textures):
            if not asset.name and asset.file:
                asset.name = PurePosixPath(asset.file).stem
        make_asset_paths_absolute(spec)
        if any_in_memory:
            put_files_in_memory(spec, f"{name}_")
    assets = _merge_assets(names, specs)
    _refer_to_slots(merged, {one.common_name: one.key.name for own in slots for one in own})
    geoms = [
        [_slot_geom(names, group[0], slot) for slot in own]
        for group, own in zip(bodies, slots, strict=True)
    ]
    _make_hulls(merged, assets, slots, specs)
    return assets, geoms


def _refer_to_slots(spec: mujoco.MjSpec, slot_names: dict[str | None, str]) -> None:
    """Replace names of geoms by those of their slots in the sensors and contact pairs of `spec`."""
    geom = mujoco.mjtObj.mjOBJ_GEOM
    for sensor in spec.sensors:
        if sensor.objtype == geom:
            sensor.objname = slot_names.get(sensor.objname, sensor.objname)
        if sensor.reftype == geom:
            sensor.refname = slot_names.get(sensor.refname, sensor.refname)
    for pair in spec.pairs:
        pair.geomname1 = slot_names.get(pair.geomname1, pair.geomname1)
        pair.geomname2 = slot_names.get(pair.geomname2, pair.geomname2)


def _merge_assets(names: list[str], specs: list[mujoco.MjSpec]) -> Assets:
    """Copy all meshes, materials and textures into the first spec, as `<variant>/<name>`."""
    merged = specs[0]
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
    merged.assets = {path: data for spec in specs for path, data in spec.assets.items()}
    return assets


def _rename_own(spec: mujoco.MjSpec, prefix: str) -> None:
    """Prefix the names of a spec's assets, and all references to them."""
    for kind in _COPY:
        for asset in list(getattr(spec, kind)):
            if kind == "materials":
                # Replaced instead of renamed: a compiled material keeps the names of its textures.
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
    """Return the geom of a slot: the first variant's geom, renamed, or a new geom without mass."""
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
    """Make the compiler compute the convex hull of every mesh that can collide.

    The compiler computes hulls only for meshes of colliding geoms, and the merged spec uses only one
    mesh per slot. A mesh keeps its hull after the geom is deleted.
    """
    needed: dict[str, None] = {}
    for slot in chain.from_iterable(slots):
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
