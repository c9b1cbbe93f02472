"""Answers to questions about a robot, from settings `KEY=VALUE`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

from mjlab.own_robot.anatomy import Kind
from mjlab.utils.errors import UnknownNameError
from mjlab.utils.string import suggest

PER_JOINT = ("pose", "effort", "armature", "stiffness", "damping", "action_scale")
"""Settings of one joint (`effort.FL_knee`), joints by pattern, or all joints (`effort`)."""
SETTINGS = ("kind", "floating_base", "front", "imu_site", "root_height", *PER_JOINT)
"""Names of settings."""

_OPTIONS: dict[str, dict[str, object]] = {
    "kind": {kind: kind for kind in get_args(Kind)},
    "floating_base": {
        **dict.fromkeys(("true", "yes", "y", "1"), True),
        **dict.fromkeys(("false", "no", "n", "0"), False),
    },
    "front": {"x": 1.0, "-x": -1.0},
}
_POSITIVE = ("effort", "stiffness", "action_scale")
_NOT_NEGATIVE = ("armature", "damping")


@dataclass(frozen=True)
class JointAnswer:
    """Answer to a setting of joints."""

    text: str
    """Setting as given, `KEY=VALUE`."""
    setting: str
    """Name of the setting, of `PER_JOINT`."""
    pattern: str
    """Joints, as a regular expression that matches whole names."""
    values: tuple[float, ...]
    """One value for all of them, or one for each in model order."""


@dataclass(frozen=True)
class Answers:
    """Answers of the user. None: not answered."""

    kind: Kind | None = None
    floating_base: bool | None = None
    front: float | None = None
    imu_site: str | None = None
    root_height: float | None = None
    of_joints: tuple[JointAnswer, ...] = ()

    def joint_values(self, setting: str, joints: list[str]) -> dict[str, float]:
        """Return the answers to a setting by joint.

        Raises:
            UnknownNameError: a pattern matches no joint.
            ValueError: as many values as joints were expected.
        """
        found: dict[str, float] = {}
        for answer in self.of_joints:
            if answer.setting != setting:
                continue
            matches = [joint for joint in joints if re.fullmatch(answer.pattern, joint)]
            if not matches:
                near = suggest(answer.pattern, joints)
                raise UnknownNameError(f"Setting {answer.text}: no such joint; {near}")
            values = answer.values
            if len(values) == 1:
                values *= len(matches)
            if len(values) != len(matches):
                raise ValueError(
                    f"Setting {answer.text}: expected one value, or one for each of "
                    f"{len(matches)} joints ({', '.join(matches)}), got {len(values)}."
                )
            found |= dict(zip(matches, values, strict=True))
        return found


def parse_settings(settings: Mapping[str, str]) -> Answers:
    """Return the answers of settings.

    Raises:
        UnknownNameError: unknown setting.
        ValueError: setting with a value that it does not have.
    """
    found: dict[str, object] = {}
    of_joints = []
    for key, value in settings.items():
        name, dot, pattern = key.partition(".")
        if name not in SETTINGS:
            raise UnknownNameError(f"Unknown setting {key!r}; {suggest(key, SETTINGS)}")
        text = f"{key}={value}"
        if name in PER_JOINT:
            values = tuple(_number(text, name, part) for part in value.split(","))
            of_joints.append(JointAnswer(text, name, _pattern(text, pattern), values))
        elif dot:
            raise ValueError(f"Setting {text}: expected {name}=VALUE, {name} is not of joints.")
        elif name == "imu_site":
            found[name] = value
        elif name == "root_height":
            found[name] = _number(text, name, value)
        else:
            found[name] = _choice(text, value, _OPTIONS[name])
    return Answers(of_joints=tuple(of_joints), **found)  # ty: ignore[invalid-argument-type]


def _choice(text: str, value: str, options: dict[str, object]) -> object:
    if value.lower() not in options:
        raise ValueError(f"Setting {text}: expected one of {list(options)}, got {value!r}.")
    return options[value.lower()]


def _number(text: str, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"Setting {text}: expected a number, got {value!r}.")
    if (name in _POSITIVE and number <= 0.0) or (name in _NOT_NEGATIVE and number < 0.0):
        least = ">" if name in _POSITIVE else ">="
        raise ValueError(f"Setting {text}: expected a number {least} 0, got {value!r}.")
    return number


def _pattern(text: str, pattern: str) -> str:
    try:
        re.compile(pattern)
    except re.error as error:
        raise ValueError(
            f"Setting {text}: expected a joint or a regular expression such as '.*_knee', "
            f"got {pattern!r} ({error})."
        ) from error
    return pattern or ".*"
