"""What all variants of an entity have to have in common, and checking that they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from mjlab.utils.mujoco import control_inputs, dof_width, qpos_width

GeomRole = Literal["visual", "collision"]

RESERVED_NAME_PREFIXES = ("mjlab/pad/",)
"""Beginnings of names that merging variants gives to geoms; specs must not use them."""

_FREE = mujoco.mjtJoint.mjJNT_FREE
_MESH = mujoco.mjtGeom.mjGEOM_MESH


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


def body_signature(body: mujoco.MjsBody, path: str) -> BodySignature:
    """Return the signature of a body, whose path is `path`."""
    children = {f"{path}/{b.name or f'body{i}'}": b for i, b in enumerate(body.bodies)}
    return BodySignature(
        path=path,
        name=body.name,
        joints=tuple(
            JointSignature(j.name, int(j.type), qpos_width(j.type), dof_width(j.type))
            for j in body.joints
        ),
        geoms=tuple(
            GeomSignature(geom.name or None, int(geom.type), geom_role(geom))
            for geom in body.geoms
            if geom.type != _MESH
        ),
        children=tuple(body_signature(child, own) for own, child in children.items()),
    )


def validate_variant_specs(names: list[str], specs: list[mujoco.MjSpec]) -> None:
    """Check that specs can be variants of one entity: they may differ in geoms and in figures.

    Raises:
        ValueError: a spec does not have exactly one top-level body with a free joint first; uses a
            reserved name; or differs from the first one in bodies, joints, kinds of inertial,
            sites, cameras, lights, actuators, sensors, tendons or equalities.
    """
    for name, spec in zip(names, specs, strict=True):
        _check_root(name, spec)
        _check_names(name, spec)
    first = _structure(specs[0])
    for name, spec in zip(names[1:], specs[1:], strict=True):
        own = _structure(spec)
        for what, expected in first.items():
            if own[what] != expected:
                raise ValueError(_difference(what, names[0], expected, name, own[what]))


def _check_root(name: str, spec: mujoco.MjSpec) -> None:
    roots = list(spec.worldbody.bodies)
    if len(roots) != 1:
        raise ValueError(
            f"Variant {name!r} has {len(roots)} top-level bodies ({[b.name for b in roots]}); it "
            "must have exactly one. Put the others below it, or make them entities of their own."
        )
    joints = list(roots[0].joints)
    if not joints or joints[0].type != _FREE:
        raise ValueError(
            f"The top-level body {roots[0].name!r} of variant {name!r} has no free joint as its "
            "first joint. Variants must float: add <freejoint/> to it."
        )
    if list(spec.worldbody.geoms) or list(spec.worldbody.sites):
        raise ValueError(
            f"Variant {name!r} has geoms or sites in its world body, which belong to no variant. "
            f"Put them into the body {roots[0].name!r}."
        )


def _check_names(name: str, spec: mujoco.MjSpec) -> None:
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


def _difference(what: str, first: str, expected: list[Any], name: str, found: list[Any]) -> str:
    """Return a message that names the first entries that are not the same."""
    missing = [entry for entry in expected if entry not in found]
    extra = [entry for entry in found if entry not in expected]
    if missing or extra:
        detail = f"{name!r} has {_shown(extra)} where {first!r} has {_shown(missing)}"
    else:
        detail = f"{name!r} has them in the order {_shown(found)}, {first!r} {_shown(expected)}"
    return (
        f"The variants {first!r} and {name!r} have other {what}: {detail}. Variants of an entity "
        f"may differ in geoms and figures alone. Give {name!r} the same {what} as {first!r}, names "
        "and order included, or make it an entity of its own."
    )


def _shown(entries: list[Any], most: int = 4) -> str:
    texts = [_text(entry) for entry in entries[:most]]
    if len(entries) > most:
        texts.append(f"... and {len(entries) - most} more")
    return ", ".join(texts) if texts else "nothing"


def _text(entry: Any) -> str:
    if isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[1], list | str):
        return f"{entry[0]}: {entry[1]}"
    return str(entry)
