"""Observation terms and measurements that programs of others know, found by what they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_NO_TURN = [1.0, 0.0, 0.0, 0.0]


def imu_field(contract: Mapping[str, Any], measurement: Mapping[str, Any]) -> str | None:
    """Return the field of the root's IMU that a measurement is, `quaternion` or `gyroscope`; else None."""
    source = measurement["source"]
    if _is_gyro_of_root(contract, source):
        return "gyroscope"
    is_of_root = source.get("body") == contract["robot"]["root_body"]
    # Other objects of a sensor are turned against the body: inertial axes, geoms, cameras.
    has_its_axes = source["kind"] == "body_quat" or source.get("site_quat") == _NO_TURN
    is_orientation = source["kind"] == "body_quat" or source.get("type") == "framequat"
    in_world = measurement["frame"] == "world"
    return "quaternion" if is_of_root and has_its_axes and is_orientation and in_world else None


def usual_term(contract: Mapping[str, Any], term: Mapping[str, Any]) -> str | None:
    """Return the usual name of a term, such as `joint_pos_rel`; None for another term.

    Names are those of Isaac Lab: `base_ang_vel`, `projected_gravity`, `joint_pos`, `joint_pos_rel`,
    `joint_vel_rel`, `last_action`, `velocity_commands`.
    """
    kind, inputs = term["kind"], term["inputs"]
    if kind == "last_action" and term["columns"] is None:
        return "last_action"
    if kind == "gravity" and inputs == ["root_quat"]:
        return "projected_gravity"
    if kind == "command" and is_velocity(_command(contract, inputs[0])):
        return "velocity_commands"
    if kind != "reading" or term["columns"] is not None or term["factor"] is not None:
        return None
    source = next(one["source"] for one in contract["measurements"] if one["name"] == inputs[0])
    if source["kind"] == "joint_pos":
        return "joint_pos" if term["offset"] is None else "joint_pos_rel"
    if source["kind"] == "joint_vel":
        return "joint_vel_rel"
    return "base_ang_vel" if _is_gyro_of_root(contract, source) else None


def _command(contract: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the entry of the command `command/<name>`."""
    name = key.removeprefix("command/")
    return next(one for one in contract["commands"] if one["name"] == name)


def is_velocity(command: Mapping[str, Any]) -> bool:
    """Return True for the velocity command of a floating base."""
    names = [component["name"] for component in command["components"]]
    return names == ["lin_vel_x", "lin_vel_y", "ang_vel_z"]


def _is_gyro_of_root(contract: Mapping[str, Any], source: Mapping[str, Any]) -> bool:
    """Return True for the angular velocity of the root in its own axes, which the IMU measures."""
    root = contract["robot"]["root_body"]
    if source["kind"] == "body_ang_vel_b":
        return source["body"] == root
    has_axes_of_root = source.get("body") == root and source.get("site_quat") == _NO_TURN
    return source.get("type") == "gyro" and has_axes_of_root
