"""The simulation options that an entity's own XML asks for.

A scene has one `<option>`. Attaching a spec to the scene drops the `<option>` of that spec, so what
an entity asks for is taken out before, and the scene decides what becomes of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

# The order of MuJoCo's MJOPTION_FIELDS (mjxmacro.h), which is that of the bits in
# `spec.authored.option`: they tell a value that was written out from one that was left open.
_AUTHORED_ORDER = (
    "timestep",
    "impratio",
    "tolerance",
    "ls_tolerance",
    "noslip_tolerance",
    "ccd_tolerance",
    "sleep_tolerance",
    "gravity",
    "wind",
    "magnetic",
    "density",
    "viscosity",
    "o_margin",
    "o_solref",
    "o_solimp",
    "o_friction",
    "integrator",
    "cone",
    "jacobian",
    "solver",
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "disableflags",
    "enableflags",
    "disableactuator",
    "sdf_initpoints",
    "sdf_iterations",
)

BIT_FIELDS = ("disableflags", "enableflags", "disableactuator")
"""Options that are sets of independent switches, one a bit."""


@dataclass(frozen=True)
class EntityOptions:
    """Options that a spec states: written out in its XML, or different from MuJoCo's defaults."""

    values: dict[str, Any] = field(default_factory=dict)
    """Option field to value: a number, or a tuple for vectors."""
    switches: dict[str, tuple[int, int]] = field(default_factory=dict)
    """For each of `BIT_FIELDS`: (bits that are set, bits about which the spec says anything)."""


def stated_options(spec: mujoco.MjSpec) -> EntityOptions:
    """Return the options that `spec` states."""
    default = mujoco.MjSpec().option
    values = {
        name: _plain(getattr(spec.option, name))
        for position, name in enumerate(_AUTHORED_ORDER)
        if name not in BIT_FIELDS
        and (
            spec.authored.option >> position & 1
            or not np.array_equal(getattr(spec.option, name), getattr(default, name))
        )
    }
    switches = {}
    for name in BIT_FIELDS:
        bits = int(getattr(spec.option, name))
        stated = bits | int(getattr(spec.authored, name))
        if stated:
            switches[name] = (bits, stated)
    return EntityOptions(values, switches)


def take_options(spec: mujoco.MjSpec) -> EntityOptions:
    """Return the options that `spec` states, and put its `<option>` back to MuJoCo's defaults.

    Without the second, MuJoCo would warn at every attachment about values that are not lost.
    """
    options, default = stated_options(spec), mujoco.MjSpec().option
    for name in _AUTHORED_ORDER:
        write_option(spec.option, name, getattr(default, name))
    spec.authored.option = 0
    for name in BIT_FIELDS:
        setattr(spec.authored, name, 0)
    return options


def write_option(option: Any, name: str, value: Any) -> None:
    """Set a field of a MuJoCo option block, element by element where it is a vector."""
    current = getattr(option, name)
    if isinstance(current, np.ndarray):
        current[:] = value
    else:
        setattr(option, name, value)


def _plain(value: Any) -> Any:
    return tuple(value.tolist()) if isinstance(value, np.ndarray) else value
