"""Actuator configs and randomization that follow from estimates, as Python source."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from mjlab.identification.estimate import DriveEstimate, Estimate, LimbEstimate
from mjlab.own_robot.python_text import commented, dict_source, literal, number, tuple_source
from mjlab.utils.tables import settings_of

LEAST_WIDTH = 0.05
"""Least half-width of a randomized range, as a share of the value: drives change with temperature and
wear by more than an interval shows."""
_UNKNOWN_GAINS = (0.9, 1.1)
_NOT_TOLD = "not told by the log"
_FIELDS = {
    "armature": "armature",
    "damping": "viscous_damping",
    "friction": "frictionloss",
    "kp": "stiffness",
    "kd": "damping",
}
"""Fields of actuator configs by kind of parameter."""
_EVENTS = (
    ("armature", "joint_armature", "armature"),
    ("joint_friction", "joint_friction", "friction"),
    ("joint_damping", "joint_damping", "damping"),
)


def actuators_source(
    limbs: Sequence[LimbEstimate],
    effort_limit: dict[str, float],
    timestep: float,
    others: Sequence[Any] = (),
) -> str:
    """Return actuator configs with the estimated values; a comment marks those that the logs do not tell.

    Args:
        limbs: Estimates.
        effort_limit: Effort limits by joint (N m or N).
        timestep: Physics timestep of the task (s), the unit of delays.
        others: Configs of the actuators of joints that the logs leave out.
    """
    classes = [("mjlab.actuator", "BuiltinPositionActuatorCfg")]
    classes += [(_module(cfg), type(cfg).__name__) for cfg in others]
    lines = [f"from {module} import {name}" for module, name in sorted(set(classes))]
    lines += ["", "ACTUATORS = ("]
    for limb in limbs:
        low, high = _lags(limb.delay, timestep)
        for drive in limb.drives:
            values = {kind: number(e.value) for kind, e in drive.parameters.items()}
            fields = {
                "stiffness": values["kp"],
                "damping": values["kd"],
                "armature": values["armature"],
                "frictionloss": values["friction"],
                "viscous_damping": values["damping"],
                "delay_min_lag": low,
                "delay_max_lag": high,
                "delay_hold_prob": 1.0,
            }
            untold = {_FIELDS[kind] for kind, e in drive.parameters.items() if not e.is_known}
            for limit, joints in _by_limit(drive.joints, effort_limit).items():
                own = {
                    "target_names_expr": tuple_source(joints, 27),
                    "effort_limit": repr(limit),
                }
                lines.append("    BuiltinPositionActuatorCfg(")
                for name, value in {**own, **fields}.items():
                    line = _indented(f"{name}={value},", 8)
                    lines.append(commented(line, _NOT_TOLD if name in untold else ""))
                lines.append("    ),")
    if others:
        lines.append("    # Joints that the log leaves out.")
        lines += [_indented(f"{_config_source(cfg)},", 4) for cfg in others]
    return "\n".join([*lines, ")"])


def _by_limit(
    joints: Sequence[str], effort_limit: dict[str, float]
) -> dict[float | None, list[str]]:
    """Return the joints of each effort limit; None: without one."""
    found: dict[float | None, list[str]] = {}
    for joint in joints:
        found.setdefault(effort_limit.get(joint), []).append(joint)
    return found


def removal_source(joints: Sequence[str]) -> str:
    """Return a function that removes the actuators of the robot's file from `joints`.

    The file's and the fitted actuators would otherwise both drive them.
    """
    return "\n".join(
        (
            f"DRIVEN_BY_FILE = {tuple_source(joints, 17)}",
            "",
            "",
            "def remove_file_actuators(spec):",
            '    """Remove the actuators that the fitted ones replace; call it in `spec_fn`."""',
            "    for actuator in list(spec.actuators):",
            "        if actuator.target in DRIVEN_BY_FILE:",
            "            spec.delete(actuator)",
        )
    )


def events_source(limbs: Sequence[LimbEstimate]) -> str:
    """Return the events that randomize the estimated values within their intervals.

    Ranges are at least `LEAST_WIDTH` to each side. Values that the logs do not tell are left out.
    """
    drives = [drive for limb in limbs for drive in limb.drives]
    lines = [
        "from mjlab.envs.mdp import dr",
        "from mjlab.managers import EventTermCfg, SceneEntityCfg",
        "",
        "EVENTS = {",
    ]
    for event, function, kind in _EVENTS:
        known = [drive for drive in drives if drive.parameters[kind].is_known]
        unknown = [joint for drive in drives if drive not in known for joint in drive.joints]
        if unknown:
            lines.append(f"    # {event}: {_NOT_TOLD} for {', '.join(unknown)}.")
        if known:
            ranges = {
                joint: _bounds(drive.parameters[kind]) for drive in known for joint in drive.joints
            }
            params = {"operation": '"abs"', "ranges": dict_source(ranges)}
            lines.append(_event(event, function, known, params))
    for kind in ("kp", "kd"):
        unknown = [j for d in drives if not d.parameters[kind].is_known for j in d.joints]
        if unknown:
            lines.append(f"    # gains: {kind} {_NOT_TOLD} for {', '.join(unknown)}.")
    gains = {
        f"{kind}_range": repr(_factors([drive.parameters[kind] for drive in drives]))
        for kind in ("kp", "kd")
    }
    lines.append(_event("gains", "pd_gains", drives, gains))
    return "\n".join([*lines, "}"])


def _config_source(cfg: Any) -> str:
    """Return the source of a config: fields that are not at their defaults."""
    lines = [
        _indented(f"{name}={_value_source(value)},", 4)
        for name, value in settings_of(cfg, changed_only=True).items()
    ]
    return "\n".join([f"{type(cfg).__name__}(", *lines, ")"])


def _value_source(value: Any) -> str:
    if isinstance(value, Enum):
        return literal(value.value)
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else number(value)
    if isinstance(value, (tuple, list)):
        is_text = all(isinstance(item, str) for item in value)
        return tuple_source(value, 27) if is_text else repr(tuple(value))
    if dataclasses.is_dataclass(value):
        return _config_source(value)
    return literal(str(value) if isinstance(value, Path) else value)


def _module(cfg: Any) -> str:
    """Return the module that a config's class is imported from."""
    module = type(cfg).__module__
    return "mjlab.actuator" if module.startswith("mjlab.actuator.") else module


def _event(
    event: str, function: str, drives: Sequence[DriveEstimate], params: dict[str, str]
) -> str:
    joints = tuple_source([joint for drive in drives for joint in drive.joints], 55)
    params = {"asset_cfg": f'SceneEntityCfg("robot", joint_names={joints})', **params}
    lines = [
        f'"{event}": EventTermCfg(',
        f"    func=dr.{function},",
        '    mode="startup",',
        "    params={",
        *(_indented(f'"{name}": {value},', 8) for name, value in params.items()),
        "    },",
        "),",
    ]
    return _indented("\n".join(lines), 4)


def _bounds(estimate: Estimate) -> tuple[float, float]:
    half = max(estimate.half_width, LEAST_WIDTH * estimate.value)
    low, high = estimate.value - half, estimate.value + half
    return float(number(max(0.0, low), 3)), float(number(high, 3))


def _factors(estimates: Sequence[Estimate]) -> tuple[float, float]:
    """Return the range of factors that covers the intervals of the known values."""
    shares = [estimate.share for estimate in estimates if estimate.is_known]
    if not shares:
        return _UNKNOWN_GAINS
    share = math.ceil(100.0 * max(*shares, LEAST_WIDTH)) / 100.0
    return round(1.0 - share, 2), round(1.0 + share, 2)


def _lags(delay: Estimate, timestep: float) -> tuple[int, int]:
    """Return the least and largest delay in physics timesteps."""
    low = math.floor((delay.value - delay.half_width) / timestep)
    return max(0, low), math.ceil((delay.value + delay.half_width) / timestep)


def _indented(text: str, spaces: int) -> str:
    return "\n".join(" " * spaces + line for line in text.splitlines())
