"""Selecting elements of an entity (joints, bodies, geoms, ...) by name or by index."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjlab.scene import Scene

# For each kind of element: the entity's method that finds it by pattern. The entity's list of
# names, and the fields below, are called after the kind: `joint_names`, `joint_ids`.
_FINDERS = {
    "joint": "find_joints",
    "body": "find_bodies",
    "geom": "find_geoms",
    "site": "find_sites",
    "actuator": "find_actuators",
    "tendon": "find_tendons",
    "camera": "find_cameras",
    "light": "find_lights",
    "material": "find_materials",
    "texture": "find_textures",
    "pair": "find_pairs",
}


@dataclass
class SceneEntityCfg:
    """Names an entity of the scene and, if wanted, some of its elements.

    A manager resolves the selections when it is built: names (regular expressions that must match
    a whole name) become the names they match, and ids the indices of these within the entity, or
    `slice(None)` where all are selected in natural order.
    """

    name: str
    """Name of the entity (or sensor) in the scene."""

    joint_names: str | tuple[str, ...] | None = None
    """Patterns of joint names; free joints do not count. None selects all."""
    joint_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of joints."""
    body_names: str | tuple[str, ...] | None = None
    """Patterns of body names. None selects all."""
    body_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of bodies."""
    geom_names: str | tuple[str, ...] | None = None
    """Patterns of geom names. None selects all."""
    geom_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of geoms."""
    site_names: str | tuple[str, ...] | None = None
    """Patterns of site names. None selects all."""
    site_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of sites."""
    actuator_names: str | list[str] | None = None
    """Patterns of actuator names. None selects all."""
    actuator_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of actuators."""
    tendon_names: str | tuple[str, ...] | None = None
    """Patterns of tendon names. None selects all."""
    tendon_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of tendons."""
    camera_names: str | tuple[str, ...] | None = None
    """Patterns of camera names. None selects all."""
    camera_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of cameras."""
    light_names: str | tuple[str, ...] | None = None
    """Patterns of light names. None selects all."""
    light_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of lights."""
    material_names: str | tuple[str, ...] | None = None
    """Patterns of material names. None selects all."""
    material_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of materials."""
    texture_names: str | tuple[str, ...] | None = None
    """Patterns of texture names. None selects all."""
    texture_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of textures."""
    pair_names: str | tuple[str, ...] | None = None
    """Patterns of contact pair names. None selects all."""
    pair_ids: list[int] | slice = field(default_factory=lambda: slice(None))
    """Indices of contact pairs."""

    preserve_order: bool = False
    """True orders the selection by pattern, as given; False keeps the entity's natural order."""

    def resolve(self, scene: Scene) -> None:
        """Fill in names and ids from the scene; resolving twice changes nothing.

        Raises `KeyError` if the scene has no such entity, and `ValueError` if a pattern matches
        nothing, two patterns match one name, an index is out of range, or names and ids are both
        given and differ.
        """
        entity = scene[self.name]
        for kind in _FINDERS:
            names, ids = getattr(self, f"{kind}_names"), getattr(self, f"{kind}_ids")
            if names is None and not isinstance(ids, list):
                continue
            if not hasattr(entity, _FINDERS[kind]):
                raise ValueError(
                    f"{self.name!r} is a {type(entity).__name__}, which has no {kind} to select; "
                    "name an entity of the scene."
                )
            names, ids = self._resolve_kind(kind, names, ids, entity)
            setattr(self, f"{kind}_names", names)
            setattr(self, f"{kind}_ids", ids)

    def empty_selections(self) -> list[str]:
        """Return the fields of names, such as `geom_names`, that explicitly select nothing."""
        fields = [f"{kind}_names" for kind in _FINDERS]
        # An empty string is a pattern, which has to match something.
        return [field for field in fields if getattr(self, field) in ((), [])]

    def _resolve_kind(
        self, kind: str, names: Any, ids: Any, entity: Any
    ) -> tuple[list[str], list[int] | slice]:
        all_names = list(getattr(entity, f"{kind}_names"))
        if names is None:
            return self._names_at(kind, ids, all_names), ids
        given = [names] if isinstance(names, str) else list(names)
        found_ids, found_names = [], []
        if given:
            # A plain name may hold characters that mean something in a pattern; names that were
            # resolved before must find themselves.
            patterns = [re.escape(name) if name in all_names else name for name in given]
            find = getattr(entity, _FINDERS[kind])
            try:
                found_ids, found_names = find(tuple(patterns), preserve_order=self.preserve_order)
            except ValueError as error:
                raise ValueError(f"entity {self.name!r}, {kind}_names={given}: {error}") from error
        found_ids, found_names = list(found_ids), list(found_names)
        if isinstance(ids, slice):
            everything = found_ids == list(range(len(all_names)))
            return found_names, slice(None) if everything else found_ids
        given_ids = [ids] if isinstance(ids, int) else list(ids)
        at_ids = self._names_at(kind, given_ids, all_names)
        if found_ids != given_ids or given != at_ids:
            raise ValueError(
                f"entity {self.name!r}: {kind}_names={given} (found at {found_ids}) and "
                f"{kind}_ids={given_ids} (named {at_ids}) do not agree. Give only one of them."
            )
        return given, ids

    def _names_at(self, kind: str, ids: list[int], all_names: list[str]) -> list[str]:
        outside = [i for i in ids if not -len(all_names) <= i < len(all_names)]
        if outside:
            raise ValueError(
                f"entity {self.name!r}: {kind}_ids {outside} do not exist; it has "
                f"{len(all_names)}: {all_names}."
            )
        return [all_names[i] for i in ids]
