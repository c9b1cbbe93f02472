"""Which geoms, bodies or subtrees of the scene a `ContactMatch` means."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mjlab.utils.string import compile_pattern, name_list

if TYPE_CHECKING:
    import mujoco

    from mjlab.entity import Entity
    from mjlab.sensor.contact_sensor import ContactMatch

logger = logging.getLogger(__name__)

_KINDS = {"geom": "geoms", "body": "bodies", "subtree": "bodies"}
# An entry of `exclude` with one of these characters is a regular expression.
_REGEX_CHARACTERS = frozenset(r".*+?[]{}()\|^$")


@dataclass(frozen=True)
class Matched:
    """An element of the scene."""

    full_name: str
    """Name in the scene."""
    name: str
    """Name in its entity; `full_name` where no entity was given."""

    def known_as(self) -> tuple[str, str]:
        """The names that a pattern may match: in the entity, and in the part it belongs to."""
        return self.name, self.name.rsplit("/", 1)[-1]


def find_matches(
    sensor: str,
    role: str,
    match: ContactMatch,
    scene_spec: mujoco.MjSpec,
    entities: dict[str, Entity],
) -> list[Matched]:
    """Return what `match`, the `role` (primary or secondary) of a sensor, means; never nothing.

    Elements of an entity come in the order of the spec, names of the scene in the order given.

    Raises:
        ValueError: no such entity; no pattern, or an empty one; a pattern that matches nothing
            (with names that are close); a name that two patterns match; everything excluded.
    """
    where = f"Contact sensor {sensor!r}: {role}"
    if not match.patterns or "" in match.patterns:
        raise ValueError(f"{where} pattern: expected at least one name, got {match.pattern!r}.")
    if not match.entity:
        return _find_literal(where, match, scene_spec)
    if match.entity not in entities:
        raise ValueError(
            f"{where} refers to the entity {match.entity!r}. The scene has: {sorted(entities)}."
            f"{_close_names(match.entity, entities)}"
        )
    prefix = f"{match.entity}/"
    elements = _elements(entities[match.entity].spec, match.mode)
    candidates = [Matched(e.name, e.name.removeprefix(prefix)) for e in elements if e.name]
    found = _matched_by_patterns(where, match, candidates)
    _warn_about_unnamed(where, match, elements)
    kept = [one for one in found if not _is_excluded(one, match.exclude)]
    if not kept:
        raise ValueError(
            f"{where}: exclude={match.exclude!r} leaves nothing of what {match.pattern!r} matches: "
            f"{name_list([one.name for one in found], near=())}."
        )
    return kept


def _elements(spec: mujoco.MjSpec, mode: str) -> list[Any]:
    # The first body of a spec is the world, which is nobody's.
    return list(spec.geoms) if mode == "geom" else list(spec.bodies[1:])


def _find_literal(where: str, match: ContactMatch, scene_spec: mujoco.MjSpec) -> list[Matched]:
    elements = scene_spec.geoms if match.mode == "geom" else scene_spec.bodies
    names = [element.name for element in elements if element.name]
    for name in match.patterns:
        if name not in names:
            raise ValueError(
                f"{where} names the {match.mode} {name!r}, which the scene does not have. Without "
                f"ContactMatch.entity, a name is taken literally.{_close_names(name, names)} "
                f"It has: {name_list(names, near=())}."
            )
    if len(set(match.patterns)) != len(match.patterns):
        raise ValueError(f"{where} names an element twice: {match.pattern!r}.")
    if match.exclude:
        logger.warning("%s: exclude has no effect without ContactMatch.entity.", where)
    return [Matched(name, name) for name in match.patterns]


def _matched_by_patterns(
    where: str, match: ContactMatch, candidates: Sequence[Matched]
) -> list[Matched]:
    owners: dict[Matched, str] = {}
    for pattern in match.patterns:
        matching = _matching(pattern, candidates)
        if not matching:
            names = [candidate.name for candidate in candidates]
            raise ValueError(
                f"{where} pattern {pattern!r} matches none of the {_KINDS[match.mode]} of entity "
                f"{match.entity!r}. A pattern must match a whole name."
                f"{_close_names(pattern, names)} It has: {name_list(names, near=())}."
            )
        for candidate in matching:
            if candidate in owners:
                raise ValueError(
                    f"{where}: {candidate.name!r} is matched by both {owners[candidate]!r} and "
                    f"{pattern!r}. Each name may be matched by one pattern only."
                )
            owners[candidate] = pattern
    return [candidate for candidate in candidates if candidate in owners]


def _matching(pattern: str, candidates: Sequence[Matched]) -> list[Matched]:
    # A name that is meant literally may contain what a regular expression reads otherwise.
    exact = [candidate for candidate in candidates if candidate.name == pattern]
    if exact:
        return exact
    regex = compile_pattern(pattern)
    return [c for c in candidates if any(regex.fullmatch(name) for name in c.known_as())]


def _is_excluded(candidate: Matched, exclude: Iterable[str]) -> bool:
    return any(
        compile_pattern(entry).search(candidate.name) is not None
        if _REGEX_CHARACTERS.intersection(entry)
        else entry in candidate.known_as()
        for entry in exclude
    )


def _warn_about_unnamed(where: str, match: ContactMatch, elements: Sequence[Any]) -> None:
    """Say which elements a pattern that matches everything cannot reach."""
    unnamed = sum(1 for element in elements if not element.name)
    if unnamed and any(compile_pattern(p).fullmatch("") for p in match.patterns):
        logger.warning(
            "%s: %d %s of entity %r have no name, so their contacts are not sensed. Name them, or "
            "use mode 'body'.",
            where, unnamed, _KINDS[match.mode], match.entity,
        )  # fmt: skip


def _close_names(name: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(names), n=3)
    return f" Close names: {', '.join(close)}." if close else ""
