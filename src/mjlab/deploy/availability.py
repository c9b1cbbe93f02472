"""Availability of a quantity on a robot: the one rule that `describe`, contracts and `check-deploy` share.

A term can be measured if all measurements that it is computed from can be. A policy to be deployed should
observe no others; a critic may: only training evaluates it.
"""

from __future__ import annotations

from typing import Literal

Availability = Literal["measured", "computed", "estimated", "external", "none", "unknown"]
"""Origin on a robot: encoders and IMU; kinematics from these; a state estimator; perception, such as
cameras; none, as only the simulation knows it; that of a value of a custom term."""

UNMEASURED: tuple[Availability, ...] = ("estimated", "external", "none")
"""Availabilities of quantities that a robot neither measures nor computes from its measurements."""

Reason = tuple[Availability, str]
"""Availability and its reason."""

ENCODERS: Reason = ("measured", "encoders")
IMU: Reason = ("measured", "IMU")
GYROSCOPE: Reason = ("measured", "gyroscope, turned to these axes")
CAMERA: Reason = ("measured", "a camera")
FIXED_BASE: Reason = ("computed", "fixed base")
KINEMATICS: Reason = ("computed", "kinematics of the joint positions and velocities")
VELOCITY: Reason = ("estimated", "velocity of the base in the world: needs a state estimator")
POSITION: Reason = ("estimated", "position in the world: needs motion capture or odometry")
CONTACT: Reason = ("estimated", "contact: needs a switch or force sensor in each foot")
HEIGHT: Reason = ("estimated", "heights of the feet above the ground: need a map of it")
SCAN: Reason = ("external", "heights of the terrain: need a depth sensor and a map")
OBJECT: Reason = ("external", "state of an object: needs a camera that tracks it")
SEGMENTATION: Reason = ("external", "object of each pixel: needs a segmentation network")
DYNAMICS: Reason = ("none", "known to the simulation only")

_SENSORS: dict[str, Reason] = {
    "gyro": ("measured", "gyroscope"),
    "accelerometer": ("measured", "accelerometer"),
    "magnetometer": ("measured", "magnetometer"),
    "framequat": IMU,
    "framexaxis": IMU,
    "frameyaxis": IMU,
    "framezaxis": IMU,
    "frameangvel": GYROSCOPE,
    "force": ("measured", "force sensor"),
    "torque": ("measured", "torque sensor"),
    "touch": ("measured", "touch sensor"),
    "tactile": ("measured", "tactile sensor"),
    "rangefinder": ("measured", "range finder"),
    "clock": ("measured", "clock"),
    **dict.fromkeys(("jointpos", "jointvel", "actuatorpos", "actuatorvel"), ENCODERS),
    **dict.fromkeys(("tendonpos", "tendonvel", "ballquat", "ballangvel"), ENCODERS),
    **dict.fromkeys(("actuatorfrc", "jointactfrc", "tendonactfrc"), ("measured", "motor currents")),
    **dict.fromkeys(
        ("jointlimitpos", "jointlimitvel", "tendonlimitpos", "tendonlimitvel"), KINEMATICS
    ),
    "velocimeter": VELOCITY,
    "framelinvel": VELOCITY,
    "framepos": POSITION,
    "contact": CONTACT,
    **dict.fromkeys(
        ("camprojection", "insidesite", "geomdist", "geomnormal", "geomfromto"), OBJECT
    ),
    **dict.fromkeys(("subtreecom", "subtreelinvel", "subtreeangmom"), DYNAMICS),
    **dict.fromkeys(("e_potential", "e_kinetic", "framelinacc", "frameangacc"), DYNAMICS),
    **dict.fromkeys(("jointlimitfrc", "tendonlimitfrc"), DYNAMICS),
}
"""Reason by type of a MuJoCo sensor of a robot that moves freely."""

_KINEMATIC = ("framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis")
_KINEMATIC += ("framelinvel", "frameangvel", "velocimeter")


def of_sensor(kind: str, is_own: bool, is_relative: bool) -> Reason:
    """Return the availability of a MuJoCo sensor.

    Args:
        kind: Type, such as `gyro`.
        is_own: True if all bodies of the sensor are of the robot.
        is_relative: True if kinematics of the joints give the poses of the sensor: relative to another body of
            the robot, or of a robot on a fixed base.
    """
    if not is_own:
        return OBJECT
    if is_relative and kind in _KINEMATIC:
        return KINEMATICS
    return _SENSORS.get(kind, ("unknown", f"sensor of type {kind}"))
