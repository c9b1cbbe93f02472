"""What becomes of the simulation options that entities ask for in their own XML.

A scene has one `<option>`. What one entity asks for is applied if nobody contradicts it: no other
entity, no `SceneCfg.spec_fn`, no `MujocoCfg`. A contradiction is reported by a `UserWarning`.
"""

from __future__ import annotations

import dataclasses
import logging
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjlab.entity.options import BIT_FIELDS, EntityOptions, write_option

if TYPE_CHECKING:
    from mjlab.sim import MujocoCfg

logger = logging.getLogger(__name__)

# Fields that MujocoCfg names as MuJoCo does, with the enum of those that it gives by name.
_ENUMS = {
    "integrator": (mujoco.mjtIntegrator, "mjINT_"),
    "cone": (mujoco.mjtCone, "mjCONE_"),
    "jacobian": (mujoco.mjtJacobian, "mjJAC_"),
    "solver": (mujoco.mjtSolver, "mjSOL_"),
}
_FLAG_ENUMS = {
    "disableflags": (mujoco.mjtDisableBit, "mjDSBL_"),
    "enableflags": (mujoco.mjtEnableBit, "mjENBL_"),
}


@dataclass(frozen=True)
class OptionRequest:
    """A value for a simulation option, and the entities that ask for it."""

    value: Any
    entities: tuple[str, ...]


def merge_entity_options(options: dict[str, EntityOptions]) -> dict[str, OptionRequest]:
    """Return what the entities ask for together: option field to request.

    Fields about which entities disagree are left out, and reported by one `UserWarning`. Of sets of
    switches (flags), only the switches are left out about which they disagree.
    """
    merged: dict[str, OptionRequest] = {}
    conflicts: list[str] = []
    for name in dict.fromkeys(name for own in options.values() for name in own.values):
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
            "so these are not applied:\n" + "\n".join(conflicts) + "\nSet them in MujocoCfg, or in "
            "SceneCfg.spec_fn where MujocoCfg does not have them.",
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


def resolve_mujoco_cfg(cfg: MujocoCfg, requests: dict[str, OptionRequest]) -> MujocoCfg:
    """Return `cfg` with what entities ask for, where `cfg` leaves its own default.

    A field of `cfg` that differs from its default and from what entities ask for keeps its value,
    and is reported by a `UserWarning`. `cfg` itself is not changed.
    """
    default = type(cfg)()
    changes: dict[str, Any] = {}
    overruled = []
    for name, request in requests.items():
        if name in BIT_FIELDS or not hasattr(cfg, name):
            # Flags of both are added up, and the rest is on the spec already.
            continue
        wanted, current = _config_value(name, request.value), getattr(cfg, name)
        if _same(current, wanted):
            continue
        if _same(current, getattr(default, name)):
            changes[name] = wanted
        else:
            overruled.append(
                f"  {name}: {current!r}, not {wanted!r} as {', '.join(request.entities)}"
            )
    if overruled:
        warnings.warn(
            "MujocoCfg sets options otherwise than the XML of an entity asks, and wins:\n"
            + "\n".join(overruled)
            + "\nRemove them from the XML to silence this.",
            UserWarning,
            stacklevel=3,
        )
    for name, value in changes.items():
        logger.info(
            "MujocoCfg.%s = %r, as the XML of %s asks.",
            name, value, ", ".join(requests[name].entities),
        )  # fmt: skip
    return dataclasses.replace(cfg, **changes)


def show(name: str, value: Any) -> str:
    """Return an option's value as people write it."""
    if name in _FLAG_ENUMS:
        enum, prefix = _FLAG_ENUMS[name]
        return str([
            member.removeprefix(prefix).lower()
            for member, bit in enum.__members__.items()
            if member.startswith(prefix) and int(value) & int(bit)
        ])  # fmt: skip
    return str(_config_value(name, value))


def _config_value(name: str, value: Any) -> Any:
    """Return MuJoCo's value of an option as `MujocoCfg` gives it."""
    if name not in _ENUMS:
        return tuple(value) if isinstance(value, np.ndarray) else value
    enum, prefix = _ENUMS[name]
    return enum(int(value)).name.removeprefix(prefix).lower()


def _same(first: Any, second: Any) -> bool:
    return bool(np.array_equal(np.asarray(first), np.asarray(second)))
