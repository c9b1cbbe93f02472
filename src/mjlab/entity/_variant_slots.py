"""Geoms that variants do not share: which of each goes into which geom of the merged spec.

The merged spec has a geom, a slot, for as many geoms as the richest variant has. A slot holds one
geom of each variant or none. What is compiled once for all environments (type, collision masks,
condim, priority, group) is a slot's own, so that only geoms alike in these share one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco

from mjlab.entity._variant_signatures import (
    RESERVED_NAME_PREFIXES,
    GeomRole,
    geom_role,
)

MESH = mujoco.mjtGeom.mjGEOM_MESH
_UNSUPPORTED = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_HFIELD: "height field",
    mujoco.mjtGeom.mjGEOM_SDF: "signed distance field",
}


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


def _floats(values: Iterable[float]) -> Any:
    return tuple(float(value) for value in values)


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


def geom_kind(geom: mujoco.MjsGeom) -> tuple[int, ...]:
    """Return what of a geom cannot differ between environments on every engine."""
    return tuple(
        int(getattr(geom, name))
        for name in ("type", "contype", "conaffinity", "condim", "priority", "group")
    )


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
    taken = [{id_of(group[k]) for group in shared} for k in range(len(bodies))]
    slots: dict[tuple[GeomRole, tuple[int, ...]], list[Slot]] = {}
    counts: Counter[GeomRole] = Counter()
    for k, own in enumerate(geoms):
        used: Counter[tuple[GeomRole, tuple[int, ...]]] = Counter()
        for geom in own:
            if id_of(geom) in taken[k]:
                continue
            _refuse_unsupported(geom, path, names[k])
            role, kind = geom_role(geom), geom_kind(geom)
            place = slots.setdefault((role, kind), [])
            if used[role, kind] == len(place):
                key = SlotKey(path, role, counts[role])
                place.append(Slot(key, kind, [None] * len(bodies)))
                counts[role] += 1
            place[used[role, kind]].geoms[k] = geom
            used[role, kind] += 1
    return shared, [slot for group in slots.values() for slot in group]


def id_of(element: mujoco.MjsGeom) -> int:
    """Return the id of an element whose spec has been compiled."""
    return int(element.id)


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


def _refuse_unsupported(geom: mujoco.MjsGeom, path: str, variant: str) -> None:
    what = _UNSUPPORTED.get(geom.type) or ("plugin" if geom.plugin.active else None)
    if what is not None:
        raise ValueError(
            f"Variant {variant!r} has the {what} geom {geom.name!r} in the body {path!r}, which "
            "its siblings do not have. Variants may differ in meshes and primitives alone: give "
            "all of them that geom, by the same name, or none."
        )
