"""Simulation options in the XML of entities: decided by `MujocoCfg`, or applied to the scene.

`MujocoCfg` decides every option that it has a field for, whatever the XML says; its flags are added
to those of the XML. Other options come from the XML, unless entities or `SceneCfg.spec_fn`
contradict each other.
"""

from __future__ import annotations

import dataclasses
import logging
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjlab.entity.options import BIT_FIELDS, EntityOptions, write_option
from mjlab.sim.config import MujocoCfg
from mjlab.utils.mujoco import OPTION_ENUMS, flag_names

logger = logging.getLogger(__name__)

_DECIDED = frozenset(field.name for field in dataclasses.fields(MujocoCfg)) - set(BIT_FIELDS)

_FLAGS = ("disableflags", "enableflags")


@dataclass(frozen=True)
class OptionRequest:
    """A value for a simulation option, and the entities that ask for it."""

    value: Any
    entities: tuple[str, ...]


def merge_entity_options(options: dict[str, EntityOptions]) -> dict[str, OptionRequest]:
    """Return what the entities ask for together, beyond what `MujocoCfg` decides.

    Fields about which entities disagree are left out, and reported by one `UserWarning`. Of sets of
    switches (flags), only the switches are left out about which they disagree.
    """
    merged: dict[str, OptionRequest] = {}
    conflicts: list[str] = []
    names = dict.fromkeys(name for own in options.values() for name in own.values)
    for name in (name for name in names if name not in _DECIDED):
        wishes = {entity: own.values[name] for entity, own in options.items() if name in own.values}
        if len(set(wishes.values())) == 1:
            merged[name] = OptionRequest(next(iter(wishes.values())), tuple(wishes))
        else:
            wanted = ", ".join(f"{show(name, v)} ({entity})" for entity, v in wishes.items())
            conflicts.append(f"  {name}: {wanted}")
    for name in BIT_FIELDS:
        _merge_switches(name, options, merged, conflicts)
    if conflicts:
        warnings.warn(
            "Entities ask in their XML for different simulation options. A scene has one of each, "
            "so these are not applied:\n" + "\n".join(conflicts) + "\nSet flags in MujocoCfg, and "
            "the others in SceneCfg.spec_fn.",
            UserWarning,
            stacklevel=3,
        )
    return merged


def _merge_switches(
    name: str,
    options: dict[str, EntityOptions],
    merged: dict[str, OptionRequest],
    conflicts: list[str],
) -> None:
    wishes = {e: own.switches[name] for e, own in options.items() if name in own.switches}
    wanted = unwanted = 0
    for bits, stated in wishes.values():
        wanted |= bits
        unwanted |= stated & ~bits
    contested = wanted & unwanted
    for entity, (bits, stated) in wishes.items():
        if stated & contested:
            yes, no = show(name, bits & contested), show(name, stated & ~bits & contested)
            conflicts.append(f"  {name}: {entity} sets {yes} and clears {no}")
    if wanted & ~contested:
        entities = tuple(e for e, (bits, _) in wishes.items() if bits & ~contested)
        merged[name] = OptionRequest(wanted & ~contested, entities)


def write_requests(option: Any, requests: dict[str, OptionRequest]) -> None:
    """Write requests onto the option block of the scene's spec."""
    for name, request in requests.items():
        write_option(option, name, request.value)
        logger.info(
            "Option %s = %s, as the XML of %s asks.",
            name, show(name, request.value), ", ".join(request.entities),
        )  # fmt: skip


def drop_overridden(option: Any, requests: dict[str, OptionRequest]) -> dict[str, OptionRequest]:
    """Return the requests that the scene's `spec_fn` left as they were; report the others."""
    kept, changed = {}, []
    for name, request in requests.items():
        current = getattr(option, name)
        if np.array_equal(current, request.value):
            kept[name] = request
        else:
            changed.append(
                f"  {name}: {show(name, current)}, not {show(name, request.value)} as "
                f"{', '.join(request.entities)}"
            )
    if changed:
        warnings.warn(
            "SceneCfg.spec_fn sets options otherwise than the XML of an entity asks:\n"
            + "\n".join(changed),
            UserWarning,
            stacklevel=3,
        )
    return kept


def report_overruled(
    cfg: MujocoCfg, stated: dict[str, EntityOptions], requests: dict[str, OptionRequest]
) -> None:
    """Log what `cfg` decides otherwise than XMLs state, one line each with the assignment to copy.

    Flags that XMLs set in addition to those of `cfg` apply, and are logged too.

    Args:
        cfg: The options that are in force.
        stated: Options by where they are stated, such as "the XML of 'robot'".
        requests: Options of entities that are applied to the scene.
    """
    for source, options in stated.items():
        for name, value in options.values.items():
            if name in _DECIDED and not _same(getattr(cfg, name), _config_value(name, value)):
                _report(source, name, getattr(cfg, name), _config_value(name, value))
        for name in _FLAGS:
            bits, known = options.switches.get(name, (0, 0))
            current, cleared = tuple(getattr(cfg, name)), flag_names(name, known & ~bits)
            kept = tuple(flag for flag in current if flag not in cleared)
            if kept != current:
                _report(source, name, current, kept)
    for name in (name for name in _FLAGS if name in requests):
        current = tuple(getattr(cfg, name))
        added = tuple(
            flag for flag in flag_names(name, requests[name].value) if flag not in current
        )
        if added:
            sources = [f"the XML of {entity!r}" for entity in requests[name].entities]
            adding = [
                s
                for s in sources
                if set(flag_names(name, stated[s].switches[name][0])) & set(added)
            ]
            logger.warning(
                "Option %s is %r, from MujocoCfg, plus %r, from %s, which applies to the whole "
                "scene; to state it in the config, set sim.mujoco.%s = %r",
                name, current, added, " and ".join(adding), name, current + added,
            )  # fmt: skip


def _report(source: str, name: str, current: Any, wanted: Any) -> None:
    logger.warning(
        "Option %s is %r, from MujocoCfg; to follow %s, set sim.mujoco.%s = %r",
        name, current, source, name, wanted,
    )  # fmt: skip


def show(name: str, value: Any) -> str:
    """Return an option's value as people write it."""
    return str(flag_names(name, value) if name in _FLAGS else _config_value(name, value))


def _config_value(name: str, value: Any) -> Any:
    """Return MuJoCo's value of an option as `MujocoCfg` gives it."""
    if name not in OPTION_ENUMS:
        return tuple(value) if isinstance(value, np.ndarray) else value
    enum, prefix = OPTION_ENUMS[name]
    return enum(int(value)).name.removeprefix(prefix).lower()


def _same(first: Any, second: Any) -> bool:
    return bool(np.array_equal(np.asarray(first), np.asarray(second)))
