"""Actuator configs and randomization that follow from estimates, as Python source."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mjlab.identification.estimate import DriveEstimate, Estimate, LimbEstimate
from mjlab.own_robot.python_text import dict_source, number, tuple_source

LEAST_WIDTH = 0.05
"""Least half-width of a randomized range, as a share of the value: drives change with temperature and
wear by more than an interval shows."""
_UNKNOWN_GAINS = (0.9, 1.1)
_EVENTS = (
    ("armature", "joint_armature", "armature"),
    ("joint_friction", "joint_friction", "friction"),
    ("joint_damping", "joint_damping", "damping"),
)


def actuators_source(
    limbs: Sequence[LimbEstimate], effort_limit: dict[str, float], timestep: float
) -> str:
    """Return actuator configs with the estimated values.

    Args:
        limbs: Estimates.
        effort_limit: Effort limits by joint (N m or N).
        timestep: Physics timestep of the task (s), the unit of delays.
    """
    lines = ["from mjlab.actuator import BuiltinPositionActuatorCfg", "", "ACTUATORS = ("]
    for limb in limbs:
        low, high = _lags(limb.delay, timestep)
        for drive in limb.drives:
            values = {kind: number(e.value) for kind, e in drive.parameters.items()}
            limit = effort_limit.get(drive.joints[0])
            fields = {
                "target_names_expr": tuple_source(drive.joints, 27),
                "stiffness": values["kp"],
                "damping": values["kd"],
                "effort_limit": repr(limit),
                "armature": values["armature"],
                "frictionloss": values["friction"],
                "viscous_damping": values["damping"],
                "delay_min_lag": low,
                "delay_max_lag": high,
                "delay_hold_prob": 1.0,
            }
            lines.append("    BuiltinPositionActuatorCfg(")
            lines += [_indented(f"{name}={value},", 8) for name, value in fields.items()]
            lines.append("    ),")
    return "\n".join([*lines, ")"])


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
            lines.append(f"    # {event}: not told by the log for {', '.join(unknown)}.")
        if known:
            ranges = {
                joint: _bounds(drive.parameters[kind]) for drive in known for joint in drive.joints
            }
            params = {"operation": '"abs"', "ranges": dict_source(ranges)}
            lines.append(_event(event, function, known, params))
    gains = {
        f"{kind}_range": repr(_factors([drive.parameters[kind] for drive in drives]))
        for kind in ("kp", "kd")
    }
    lines.append(_event("gains", "pd_gains", drives, gains))
    return "\n".join([*lines, "}"])


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
