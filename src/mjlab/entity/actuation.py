"""Resolving actuator configs to an entity's joints, tendons and sites."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mjlab.actuator import TransmissionType, XmlActuatorCfg
from mjlab.actuator.xml_actuator import XML_TRANSMISSIONS
from mjlab.entity.initial_state import short_name

if TYPE_CHECKING:
    from mjlab.actuator import Actuator, ActuatorCfg
    from mjlab.entity.entity import Entity

_ORDER = {TransmissionType.JOINT: 0, TransmissionType.TENDON: 1, TransmissionType.SITE: 2}


def build_actuators(entity: Entity) -> list[Actuator]:
    """Build the configured actuators and add their elements to the entity's spec.

    Elements come config by config, or, with `sort_actuators`, in the order of what they act on
    (joints, then tendons, then sites), after those that the XML already has.

    Raises:
        ValueError: the patterns of a config do not resolve, with the reason and the candidates; or
            what they match has an actuator already, of another config, or of the XML with the name
            that the new one gets. Other actuators of the XML stay, with a warning: both act.
    """
    articulation = entity.cfg.articulation
    if articulation is None:
        return []
    built = []
    for cfg in articulation.actuators:
        ids, names = _find_targets(entity, cfg)
        built.append((cfg.build(entity, ids, names), ids))
    _check_second_actuators(entity, built)
    if entity.cfg.sort_actuators:
        _add_sorted(entity, built)
    else:
        # Those that wrap the XML's actuators come first, before there are others to find. They
        # add nothing.
        for actuator, ids in sorted(built, key=lambda pair: not _wraps_xml(pair[0])):
            _add(entity, actuator, ids)
    return [actuator for actuator, _ in built]


def _wraps_xml(actuator: Actuator) -> bool:
    return isinstance(actuator.cfg, XmlActuatorCfg)


def _check_second_actuators(entity: Entity, built: list[tuple[Actuator, list[int]]]) -> None:
    """Warn if a config adds an actuator to a target that has one of the XML: their forces add up.

    Raises:
        ValueError: two configs act on one target, or the actuators would have the same name.
    """
    in_xml: dict[tuple[TransmissionType, str], list[str]] = {}
    for element in entity.spec.actuators:
        for transmission, kinds in XML_TRANSMISSIONS.items():
            if element.trntype in kinds:
                in_xml.setdefault((transmission, element.target), []).append(element.name)
    names_in_xml = {element.name for element in entity.spec.actuators}
    claimed: dict[tuple[bool, TransmissionType, str], str] = {}
    for actuator, ids in built:
        cfg, kind = actuator.cfg, actuator.transmission_type
        wraps = _wraps_xml(actuator)
        label = f"{type(cfg).__name__}({cfg.target_names_expr!r})"
        names = [_elements(entity, kind)[index].name for index in ids]
        # One that wraps those of the XML leaves out what has none.
        names = [name for name in names if (kind, name) in in_xml or not wraps]
        taken = {
            n: f"one by {claimed[wraps, kind, n]}" for n in names if (wraps, kind, n) in claimed
        }
        beside = {
            name: " and ".join(
                f"the actuator {other or '(unnamed)'!r} of the XML" for other in in_xml[kind, name]
            )
            for name in names
            if not wraps and (kind, name) in in_xml
        }
        taken |= {name: by for name, by in beside.items() if name in in_xml[kind, name]}
        message = f"{label} acts on {kind.value}s that have an actuator already: "
        if taken:
            raise ValueError(
                f"{message}{_list_taken(taken)}. Give each one actuator: narrow the patterns, remove "
                "the actuator from the XML, or use it as it is there, by XmlActuatorCfg alone."
            )
        # New actuators are named as what they act on.
        same = [short_name(name) for name in names if not wraps and name in names_in_xml]
        if same:
            raise ValueError(
                f"{label} adds actuators to the {kind.value}s {same}, and names them so; the XML has "
                "actuators of these names on other targets. Rename or remove those in the XML."
            )
        if beside:
            warnings.warn(
                f"{message}{_list_taken(beside)}. Both act, and their forces add up. If that is not "
                "meant, remove the actuator from the XML.",
                UserWarning,
                stacklevel=2,
            )
        claimed |= dict.fromkeys(((wraps, kind, name) for name in names), label)


def _list_taken(taken: dict[str, str]) -> str:
    return ", ".join(f"{short_name(name)!r} has {by}" for name, by in taken.items())


def _add(entity: Entity, actuator: Actuator, ids: list[int]) -> None:
    # An entity's own names leave out the prefixes of specs that it was put together from, but
    # elements of the spec refer to each other by full names.
    elements = _elements(entity, actuator.transmission_type)
    actuator.edit_spec(entity.spec, [elements[index].name for index in ids])


def _add_sorted(entity: Entity, built: list[tuple[Actuator, list[int]]]) -> None:
    pairs = []
    for position, (actuator, ids) in enumerate(built):
        if _wraps_xml(actuator):
            _add(entity, actuator, ids)
        else:
            order = _ORDER[actuator.transmission_type]
            pairs.extend((order, index, position, actuator) for index in ids)
    for _, index, _, actuator in sorted(pairs, key=lambda pair: pair[:3]):
        _add(entity, actuator, [index])


def _elements(entity: Entity, transmission: TransmissionType) -> Sequence[Any]:
    if transmission == TransmissionType.JOINT:
        return entity.joints
    return entity.spec.tendons if transmission == TransmissionType.TENDON else entity.spec.sites


def _namespace(entity: Entity, transmission: TransmissionType) -> tuple[str, ...]:
    return tuple(short_name(element.name) for element in _elements(entity, transmission))


def _find_targets(entity: Entity, cfg: ActuatorCfg) -> tuple[list[int], list[str]]:
    patterns, kind = cfg.target_names_expr, cfg.transmission_type
    find = {
        TransmissionType.JOINT: entity.find_joints,
        TransmissionType.TENDON: entity.find_tendons,
        TransmissionType.SITE: entity.find_sites,
    }[kind]
    try:
        ids, names = find(patterns)
    except ValueError as error:
        raise ValueError(
            f"{type(cfg).__name__}(target_names_expr={patterns!r}, transmission_type="
            f"{kind.value!r}): {error}{_elsewhere(entity, cfg)}"
        ) from None
    if not names:
        raise ValueError(
            f"{type(cfg).__name__}(target_names_expr={patterns!r}) names no {kind.value}. "
            f"Available: {list(_namespace(entity, kind))}."
        )
    if "" in names:
        raise ValueError(
            f"{type(cfg).__name__}(target_names_expr={patterns!r}) matches a {kind.value} without "
            "a name, which no actuator can refer to. Name it in the XML."
        )
    _warn_if_ambiguous(entity, cfg)
    return ids, names


def _elsewhere(entity: Entity, cfg: ActuatorCfg) -> str:
    """Say where else the patterns match, for somebody who forgot the transmission type."""
    hints = []
    for other in _others(cfg):
        found = [n for n in _namespace(entity, other) if _any_match(cfg.target_names_expr, n)]
        if found:
            hints.append(
                f"{other.value}s {found} (transmission_type=TransmissionType.{other.name})"
            )
    return f"\nThe patterns do match: {'; '.join(hints)}." if hints else ""


def _warn_if_ambiguous(entity: Entity, cfg: ActuatorCfg) -> None:
    patterns = cfg.target_names_expr
    for other in _others(cfg):
        names = _namespace(entity, other)
        if all(any(re.fullmatch(pattern, name) for name in names) for pattern in patterns):
            found = [name for name in names if _any_match(patterns, name)]
            warnings.warn(
                f"{type(cfg).__name__}(target_names_expr={patterns!r}) acts on "
                f"{cfg.transmission_type.value}s, but its patterns also match the {other.value}s "
                f"{found}. Make the patterns unambiguous, or set transmission_type.",
                UserWarning,
                stacklevel=2,
            )


def _others(cfg: ActuatorCfg) -> list[TransmissionType]:
    return [kind for kind in TransmissionType if kind != cfg.transmission_type]


def _any_match(patterns: tuple[str, ...], name: str) -> bool:
    return any(re.fullmatch(pattern, name) for pattern in patterns)
