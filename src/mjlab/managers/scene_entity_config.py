"""Selection of entity elements (joints, bodies, geoms, ...) by name or index."""

from __future__ import annotations

import contextlib
import copy
import re
import sys
from collections.abc import Generator
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjlab.scene import Scene

# Kind of element to the entity's method that finds it by pattern. The entity's list of names and
# the fields below have the kind in their names: `joint_names`, `joint_ids`.
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
    """Selection of a scene entity and, optionally, of its elements.

    Managers resolve selections when they are built: names (regular expressions, matched in full)
    become the matching names, and ids become the indices of these elements within the entity, or
    `slice(None)` for all elements in natural order.
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
    """Order the selection by pattern instead of the entity's natural order."""

    _is_resolved = False

    def __str__(self) -> str:
        """Return the entity and its selected elements: `robot`, `robot joint hip`, `robot 12 joints`."""
        parts = [self.name]
        for kind in _FINDERS:
            names = getattr(self, f"{kind}_names")
            if names is not None:
                names = [names] if isinstance(names, str) else names
                plural = f"{kind[:-1]}ies" if kind.endswith("y") else f"{kind}s"
                parts.append(f"{kind} {names[0]}" if len(names) == 1 else f"{len(names)} {plural}")
        return " ".join(parts)

    def resolve(self, scene: Scene) -> None:
        """Resolve names and ids in the scene. Resolving is idempotent.

        Raises `KeyError` for an unknown entity, and `ValueError` if a pattern matches nothing, two
        patterns match one name, an index is out of range, or names and ids disagree.
        """
        entity = scene[self.name]
        for kind in _FINDERS:
            names, ids = getattr(self, f"{kind}_names"), getattr(self, f"{kind}_ids")
            if names is None and not isinstance(ids, list):
                continue
            if not hasattr(entity, _FINDERS[kind]):
                raise ValueError(
                    f"{self.name!r}: expected an entity of the scene to select a {kind}, got "
                    f"{type(entity).__name__}."
                )
            names, ids = self._resolve_kind(kind, names, ids, entity)
            setattr(self, f"{kind}_names", names)
            setattr(self, f"{kind}_ids", ids)
        self._is_resolved = True

    @property
    def selects_names(self) -> bool:
        """True if the selection has patterns of names."""
        return any(getattr(self, f"{kind}_names") is not None for kind in _FINDERS)

    def empty_selections(self) -> list[str]:
        """Return the fields of names, such as `geom_names`, that explicitly select nothing."""
        fields = [f"{kind}_names" for kind in _FINDERS]
        # An empty string is a pattern and must match a name.
        return [field for field in fields if getattr(self, field) in ((), [])]

    def _resolve_kind(
        self, kind: str, names: Any, ids: Any, entity: Any
    ) -> tuple[list[str], list[int] | slice]:
        all_names = list(getattr(entity, f"{kind}_names"))
        if names is None:
            return self._names_at(kind, ids, all_names), ids
        requested = [names] if isinstance(names, str) else list(names)
        found_ids, found_names = [], []
        if requested:
            # Plain names may hold special characters of regular expressions; resolved names must
            # match themselves.
            patterns = [re.escape(name) if name in all_names else name for name in requested]
            find = getattr(entity, _FINDERS[kind])
            try:
                found_ids, found_names = find(tuple(patterns), preserve_order=self.preserve_order)
            except ValueError as error:
                raise ValueError(
                    f"entity {self.name!r}, {kind}_names={requested}: {error}"
                ) from error
        found_ids, found_names = list(found_ids), list(found_names)
        if isinstance(ids, slice):
            everything = found_ids == list(range(len(all_names)))
            return found_names, slice(None) if everything else found_ids
        requested_ids = [ids] if isinstance(ids, int) else list(ids)
        at_ids = self._names_at(kind, requested_ids, all_names)
        if found_ids != requested_ids or requested != at_ids:
            raise ValueError(
                f"entity {self.name!r}: {kind}_names={requested} (ids {found_ids}) and "
                f"{kind}_ids={requested_ids} (names {at_ids}) disagree; set only one of them."
            )
        return requested, ids

    def _names_at(self, kind: str, ids: list[int], all_names: list[str]) -> list[str]:
        outside = [i for i in ids if not -len(all_names) <= i < len(all_names)]
        if outside:
            raise ValueError(
                f"entity {self.name!r} {kind}_ids: expected indices into {len(all_names)} "
                f"{kind}_names {all_names}, got {outside}."
            )
        return [all_names[i] for i in ids]


# Scene whose terms are being built or run.
_scene: ContextVar[Scene | None] = ContextVar("scene", default=None)


@contextlib.contextmanager
def selections_checked(scene: Scene | None) -> Generator[None]:
    """Within the block, reading ids of a selection with names that was never resolved is an error.

    These ids would silently select all elements: managers resolve parameters, but neither constants
    nor selections that a term creates. No error if the names do select all elements.

    Raises:
        ValueError: such ids were read; the message names the selection and the cure.
    """
    token = _scene.set(scene)
    try:
        yield
    finally:
        _scene.reset(token)


class _Ids:
    """Field of ids of a kind of element. Reading it is checked within `selections_checked`."""

    def __init__(self, kind: str) -> None:
        self._ids, self._names = f"{kind}_ids", f"{kind}_names"

    def __get__(self, cfg: Any, owner: type | None = None) -> Any:
        state = getattr(cfg, "__dict__", {})
        if cfg is None or self._ids not in state:
            raise AttributeError(f"{owner} has no {self._ids}")
        ids = state[self._ids]
        if type(ids) is slice and not cfg._is_resolved and state[self._names] is not None:
            # Copies and representations are made of unresolved selections, too.
            reader = sys._getframe(1).f_globals.get("__name__")
            if (scene := _scene.get()) is not None and reader not in (__name__, "dataclasses"):
                self._check(cfg, ids, scene)
        return ids

    def __set__(self, cfg: Any, ids: Any) -> None:
        cfg.__dict__[self._ids] = ids

    def _check(self, cfg: SceneEntityCfg, ids: slice, scene: Scene) -> None:
        resolved = copy.deepcopy(cfg)
        resolved.resolve(scene)
        if getattr(resolved, self._ids) != ids:
            names = getattr(cfg, self._names)
            raise ValueError(
                f"SceneEntityCfg of {cfg.name!r} {self._ids}: expected a resolved selection, got one that "
                f"selects all and not {self._names}={names!r}; pass it as a parameter of the term, or "
                "call its resolve(env.scene) first."
            )


for _kind in _FINDERS:
    setattr(SceneEntityCfg, f"{_kind}_ids", _Ids(_kind))
