"""Selection of entity elements (joints, bodies, geoms, ...) by name or index."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import torch

from mjlab.entity import Entity
from mjlab.utils.indexing import Columns, as_columns

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
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
# Kind that follows from another: its kind, and the entity's list of the owner of each element.
_FOLLOWS = {"actuator": ("joint", "actuator_joints"), "geom": ("body", "geom_bodies")}


@dataclass
class SceneEntityCfg:
    """Selection of a scene entity and, optionally, of its elements.

    Managers resolve selections when they are built: names (regular expressions, matched in full)
    become the matching names, and ids become the indices of these elements within the entity, or
    `slice(None)` for all elements in natural order.

    Selected joints select their actuators, and selected bodies their geoms, unless these are
    selected too. Other kinds that are not selected stay `slice(None)`, all elements. Terms of this
    package warn where they use all elements of a kind although only other kinds are selected.
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

    # Kinds with elements that a resolved selection selects, or that follow from these. Without an
    # annotation, because an annotation would make it a field.
    _kinds = cast("tuple[str, ...]", ())

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
        patterns match one name, an index is out of range, or names and ids disagree. The selection
        is then unchanged.
        """
        entity: Any = scene[self.name]
        kinds = self.selected_kinds()
        resolved: dict[str, Any] = {}
        for kind in kinds:
            names, ids = getattr(self, f"{kind}_names"), getattr(self, f"{kind}_ids")
            if names is None and not isinstance(ids, list):
                continue
            if not hasattr(entity, _FINDERS[kind]):
                raise ValueError(
                    f"{self.name!r}: expected an entity of the scene to select a {kind}, got "
                    f"{type(entity).__name__}."
                )
            names, ids = self._resolve_kind(kind, names, ids, entity)
            resolved |= {f"{kind}_names": names, f"{kind}_ids": ids}
        for kind, (source, owners) in _FOLLOWS.items():
            if source in kinds and kind not in kinds and isinstance(entity, Entity):
                ids = resolved.get(f"{source}_ids", getattr(self, f"{source}_ids"))
                count = len(getattr(entity, f"{source}_names"))
                following = _following(getattr(entity, owners), ids, count)
                resolved[f"{kind}_ids"] = following
                if following != [] or resolved.get(f"{source}_names") == []:
                    kinds.append(kind)
        for name, value in resolved.items():
            setattr(self, name, value)
        self._kinds = tuple(kinds)

    def selected_kinds(self) -> list[str]:
        """Return the kinds of elements selected by names or ids, such as `joint`."""
        return [
            kind
            for kind in _FINDERS
            if getattr(self, f"{kind}_names") is not None
            or not _is_all(getattr(self, f"{kind}_ids"))
        ]

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
        at_ids = self._names_at(kind, ids, all_names) if isinstance(ids, list) else all_names
        # Names of a resolved selection are no patterns: unnamed geoms repeat a name.
        if requested == at_ids:
            return requested, ids if isinstance(ids, list) else slice(None)
        # Plain names may hold special characters of regular expressions.
        patterns = tuple(re.escape(name) if name in all_names else name for name in requested)
        try:
            find = getattr(entity, _FINDERS[kind])
            found = find(patterns, preserve_order=self.preserve_order) if patterns else ([], [])
        except ValueError as error:
            raise ValueError(f"entity {self.name!r}, {kind}_names={requested}: {error}") from error
        found_ids, found_names = map(list, found)
        if isinstance(ids, list):
            raise ValueError(
                f"entity {self.name!r}: {kind}_names={requested} (ids {found_ids}) and "
                f"{kind}_ids={ids} (names {at_ids}) disagree; set only one of them."
            )
        return found_names, _slice_if_all(found_ids, len(all_names))

    def _names_at(self, kind: str, ids: list[int], all_names: list[str]) -> list[str]:
        outside = [i for i in ids if not -len(all_names) <= i < len(all_names)]
        if outside:
            raise ValueError(
                f"entity {self.name!r} {kind}_ids: expected indices into {len(all_names)} "
                f"{kind}_names {all_names}, got {outside}."
            )
        return [all_names[i] for i in ids]


def columns_of(asset_cfg: SceneEntityCfg, kind: str, env: ManagerBasedRlEnv) -> Columns:
    """Return the column index of the selected elements of a kind, such as "joint", for a term.

    Warns if only other kinds are selected, because the term then uses all elements of this one, or
    none if no element of this kind follows from the selected ones.
    """
    ids = getattr(asset_cfg, f"{kind}_ids")
    if asset_cfg._kinds and kind not in asset_cfg._kinds:
        selected = {k: getattr(asset_cfg, f"{k}_names") for k in asset_cfg._kinds}
        shown = ", ".join(f"{k}_names={names}" for k, names in selected.items())
        used = f"no {kind}; set {kind}_names" if ids == [] else (
            f"every {kind}; set {kind}_names, to '.*' for all"
        )  # fmt: skip
        warnings.warn(
            f"SceneEntityCfg of {asset_cfg.name!r} {kind}_ids: expected {kind}_names, got {shown}; "
            f"the term uses {used}.",
            UserWarning,
            stacklevel=2,
        )
    return as_columns(ids, env.device)


def _following(owners: Sequence[int | None], ids: Any, count: int) -> list[int] | slice:
    """Return the elements owned by `ids` out of `count`: in natural order, or in that of the ids."""
    ids = ids.cpu() if isinstance(ids, torch.Tensor) else as_columns(ids, "cpu")
    chosen = torch.arange(count)[ids].flatten().tolist()
    found = [element for element, owner in enumerate(owners) if owner in chosen]
    if chosen != sorted(chosen):
        found.sort(key=lambda element: chosen.index(owners[element]))
    return _slice_if_all(found, len(owners))


def _slice_if_all(ids: list[int], count: int) -> list[int] | slice:
    return slice(None) if ids == list(range(count)) and count > 0 else ids


def _is_all(ids: Any) -> bool:
    return isinstance(ids, slice) and ids == slice(None)
