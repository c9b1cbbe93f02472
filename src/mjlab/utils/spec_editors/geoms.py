"""Editors of geoms: a patch of chosen attributes, and a complete collision setup."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco

from mjlab.compat import accepts_older_fields, older_defaults, set_array_field
from mjlab.utils.spec_editors.base import SpecCfg, check_values
from mjlab.utils.string import filter_exp, resolve_field

_REQUIRED = ("contype", "conaffinity", "condim", "priority")
_ARRAYS = {"friction": 3, "solref": 2, "solimp": 5}
_PATCHES = (*_ARRAYS, "margin", "gap", "solmix")
_MAX_LISTED = 8


@dataclass
class GeomCfg(SpecCfg):
    """A patch of geoms: what is None, or has no pattern that matches, stays as it is.

    Every attribute is one value for all, or a dict of name pattern (matched at the start of the
    name, the first in dict order counts) to value.
    """

    geom_names_expr: tuple[str, ...]
    """Patterns that choose the geoms, matched at the start of the name."""
    group: int | dict[str, int] | None = None
    """Visualization group, 0 to 5."""
    contype: int | dict[str, int] | None = None
    """Collision type bits."""
    conaffinity: int | dict[str, int] | None = None
    """Bits of the collision types this geom collides with."""
    condim: int | dict[str, int] | None = None
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int] | None = None
    """The geom with the higher priority decides friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Sliding, torsional and rolling friction; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance (m) below which a contact is found."""
    gap: float | dict[str, float] | None = None
    """Distance (m) by which a contact found is inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight, 0 to 1, for averaging the contact parameters of two geoms."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Patch the geoms. Raises `ValueError` if a value is not valid."""
        self.validate()
        geoms = _matched_geoms(spec, self.geom_names_expr)
        for field in ("group", *_REQUIRED, *_PATCHES):
            _patch(geoms, field, getattr(self, field))

    def validate(self) -> None:
        """Raise `ValueError`, naming the field, the pattern and what is allowed."""
        check_values(self, "group", lambda value: value in range(6), "from 0 to 5")
        _validate_collision(self)


@accepts_older_fields
@dataclass
class CollisionCfg(SpecCfg):
    """The collision setup of an entity. Values are given as in `GeomCfg`.

    The four required attributes are always written, so dicts should cover every geom chosen; what
    no pattern names gets contype 1, conaffinity 1, condim 3 or priority 0, with a warning. The
    others are patches.
    """

    geom_names_expr: tuple[str, ...]
    """Patterns that choose the geoms, matched at the start of the name."""
    contype: int | dict[str, int]
    """Collision type bits."""
    conaffinity: int | dict[str, int]
    """Bits of the collision types these geoms collide with."""
    condim: int | dict[str, int]
    """Contact dimension: 1, 3, 4 or 6."""
    priority: int | dict[str, int]
    """The geom with the higher priority decides friction and solver parameters of a contact."""
    friction: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Sliding, torsional and rolling friction; fewer values set the first ones."""
    solref: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver reference; fewer values set the first ones."""
    solimp: tuple[float, ...] | dict[str, tuple[float, ...]] | None = None
    """Contact solver impedance; fewer values set the first ones."""
    margin: float | dict[str, float] | None = None
    """Distance (m) below which a contact is found."""
    gap: float | dict[str, float] | None = None
    """Distance (m) by which a contact found is inactive."""
    solmix: float | dict[str, float] | None = None
    """Weight, 0 to 1, for averaging the contact parameters of two geoms."""
    disable_other_geoms: bool = True
    """Switch off collisions of every geom that no pattern matches."""
    set_array_field = staticmethod(set_array_field)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        """Write the setup. Raises `ValueError` if a value is not valid."""
        self.validate()
        geoms = _matched_geoms(spec, self.geom_names_expr)
        for field, values in self._required_values([geom.name for geom in geoms]).items():
            for geom, value in zip(geoms, values, strict=True):
                setattr(geom, field, value)
        for field in _PATCHES:
            _patch(geoms, field, getattr(self, field))
        if self.disable_other_geoms:
            for geom in _other_geoms(spec, self.geom_names_expr):
                geom.contype = geom.conaffinity = 0

    def validate(self) -> None:
        """Raise `ValueError`, naming the field, the pattern and what is allowed."""
        for field in _REQUIRED:
            if getattr(self, field) is None:
                raise ValueError(f"CollisionCfg.{field} is None; it must have a value.")
        _validate_collision(self)

    def _required_values(self, names: Sequence[str]) -> dict[str, list[Any]]:
        """Return the required attributes of the geoms `names`, by field."""
        found = {field: resolve_field(getattr(self, field), tuple(names)) for field in _REQUIRED}
        missing = {
            field: [name for name, value in zip(names, values, strict=True) if value is None]
            for field, values in found.items()
        }
        defaults = older_defaults(CollisionCfg, missing)
        return {
            field: [defaults[field] if value is None else value for value in values]
            for field, values in found.items()
        }


def _validate_collision(cfg: GeomCfg | CollisionCfg) -> None:
    for field in ("contype", "conaffinity", "priority", "margin", "gap"):
        check_values(cfg, field, lambda value: value >= 0, "at least 0")
    check_values(cfg, "condim", lambda value: value in (1, 3, 4, 6), "1, 3, 4 or 6")
    check_values(cfg, "solmix", lambda value: 0 <= value <= 1, "from 0 to 1")
    for field, size in _ARRAYS.items():
        check_values(
            cfg,
            field,
            lambda value, size=size: isinstance(value, (tuple, list)) and 1 <= len(value) <= size,
            f"a tuple of 1 to {size} numbers",
        )


def _matched_geoms(spec: mujoco.MjSpec, patterns: Sequence[str]) -> list[mujoco.MjsGeom]:
    chosen = set(filter_exp(tuple(patterns), tuple(geom.name for geom in spec.geoms)))
    return [geom for geom in spec.geoms if geom.name in chosen]


def _other_geoms(spec: mujoco.MjSpec, patterns: Sequence[str]) -> list[mujoco.MjsGeom]:
    chosen = {geom.name for geom in _matched_geoms(spec, patterns)}
    return [geom for geom in spec.geoms if geom.name not in chosen]


def _patch(geoms: Sequence[mujoco.MjsGeom], field: str, value: Any) -> None:
    if value is None:
        return
    values = resolve_field(value, tuple(geom.name for geom in geoms))
    for geom, entry in zip(geoms, values, strict=True):
        if entry is None:
            continue
        if field in _ARRAYS:
            getattr(geom, field)[: len(entry)] = entry
        else:
            setattr(geom, field, entry)


def warn_overlapping_geom_edits(
    geom_cfgs: Sequence[GeomCfg],
    collision_cfgs: Sequence[CollisionCfg],
    spec: mujoco.MjSpec,
) -> None:
    """Warn (`UserWarning`) where a `CollisionCfg` overwrites what a `GeomCfg` sets.

    Up to eight of them are listed as "geom.attribute".
    """
    patched = _edited_attributes(geom_cfgs, spec)
    overwritten = _edited_attributes(collision_cfgs, spec)
    for cfg in collision_cfgs:
        if cfg.disable_other_geoms:
            for geom in _other_geoms(spec, cfg.geom_names_expr):
                overwritten |= {(geom.name, "contype"), (geom.name, "conaffinity")}
    overlap = sorted(patched & overwritten)
    if overlap:
        listed = ", ".join(f"{geom}.{field}" for geom, field in overlap[:_MAX_LISTED])
        more = len(overlap) - _MAX_LISTED
        warnings.warn(
            f"A CollisionCfg overwrites what a GeomCfg sets: {listed}"
            + (f" and {more} more." if more > 0 else "."),
            UserWarning,
            stacklevel=2,
        )


def _edited_attributes(
    cfgs: Sequence[GeomCfg] | Sequence[CollisionCfg], spec: mujoco.MjSpec
) -> set[tuple[str, str]]:
    edited = set()
    for cfg in cfgs:
        names = tuple(geom.name for geom in _matched_geoms(spec, cfg.geom_names_expr))
        for field in (*_REQUIRED, *_PATCHES):
            always = isinstance(cfg, CollisionCfg) and field in _REQUIRED
            values = names if always else resolve_field(getattr(cfg, field), names)
            edited |= {
                (name, field)
                for name, value in zip(names, values, strict=True)
                if value is not None
            }
    return edited
