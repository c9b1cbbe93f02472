"""What can be wrong with the config of a camera sensor, and how a camera's projection is set."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco

from mjlab.sim.engine import CAMERA_DATA_TYPES, NUM_GEOM_GROUPS

if TYPE_CHECKING:
    from mjlab.sensor.camera_sensor import CameraSensor, CameraSensorCfg

_MAX_FOVY = 180.0


def check_camera_cfg(cfg: CameraSensorCfg) -> None:
    """Raise ValueError for what is wrong with `cfg`, whatever the scene."""
    for problem in (
        _size_problem(cfg),
        _data_problem(cfg),
        _group_problem(cfg),
        _lens_problem(cfg),
    ):
        if problem is not None:
            raise ValueError(f"Camera sensor {cfg.name!r}: {problem}")


def _size_problem(cfg: CameraSensorCfg) -> str | None:
    for name in ("width", "height"):
        value = getattr(cfg, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            return (
                f"{name} is {value!r}; an image has a whole number of pixels, at least 1 each way "
                "(such as width=32, height=32)."
            )
    return None


def _data_problem(cfg: CameraSensorCfg) -> str | None:
    choice = f"Choose from: {', '.join(CAMERA_DATA_TYPES)}."
    if isinstance(cfg.data_types, str):
        return f"data_types is the string {cfg.data_types!r}; give a tuple. {choice}"
    if not cfg.data_types:
        return f"data_types is empty, so that the camera would measure nothing. {choice}"
    unknown = [kind for kind in cfg.data_types if kind not in CAMERA_DATA_TYPES]
    if unknown:
        return f"data_types has {', '.join(map(repr, unknown))}, which is unknown. {choice}"
    if len(set(cfg.data_types)) < len(cfg.data_types):
        return f"data_types={cfg.data_types!r} names one of them twice."
    return None


def _group_problem(cfg: CameraSensorCfg) -> str | None:
    known = f"Geom groups are 0 to {NUM_GEOM_GROUPS - 1}."
    if not cfg.enabled_geom_groups:
        return f"enabled_geom_groups is empty, so that the camera would see nothing. {known}"
    unknown = [group for group in cfg.enabled_geom_groups if group not in range(NUM_GEOM_GROUPS)]
    if unknown:
        return f"enabled_geom_groups has {', '.join(map(str, unknown))}, which is unknown. {known}"
    return None


def _lens_problem(cfg: CameraSensorCfg) -> str | None:
    if cfg.fovy is None:
        return None
    if not (cfg.fovy > 0.0 and math.isfinite(cfg.fovy)):
        return f"fovy is {cfg.fovy}; it has to be positive and finite."
    if not cfg.orthographic and cfg.camera_name is None and cfg.fovy >= _MAX_FOVY:
        return f"fovy is {cfg.fovy}; a field of view is less than {_MAX_FOVY:g} degrees."
    return None


def find_camera(name: str, cameras: Sequence[str]) -> str:
    """Return what to say about a camera `name` that is not among `cameras`."""
    named = [camera for camera in cameras if camera]
    close = difflib.get_close_matches(name, named, n=1, cutoff=0.5)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    offered = f"The scene has: {', '.join(sorted(named))}." if named else "The scene has no camera."
    return (
        f"there is no camera {name!r}. Names have the prefix of their entity, such as "
        f"'robot/wrist'. {offered}{hint}"
    )


def set_field_of_view(camera: mujoco.MjsCamera, fovy: float | None, *, orthographic: bool) -> None:
    """Change the projection of a camera; None and False leave it as it is."""
    if orthographic:
        camera.proj = mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC
    if fovy is not None:
        camera.fovy = fovy
        # The compiler ignores the field of view of a camera that has a sensor.
        camera.sensor_size = [0.0, 0.0]
        camera.focal_length, camera.focal_pixel = [0.0, 0.0], [0.0, 0.0]
        camera.principal_length, camera.principal_pixel = [0.0, 0.0], [0.0, 0.0]


def check_shared_cameras(sensors: Sequence[CameraSensor]) -> None:
    """Raise ValueError if sensors want one camera to have several projections."""
    first: dict[str, CameraSensor] = {}
    for sensor in sensors:
        other = first.setdefault(sensor.camera_name, sensor)
        for field in ("fovy", "orthographic"):
            values = getattr(other.cfg, field), getattr(sensor.cfg, field)
            if values[0] != values[1]:
                raise ValueError(
                    f"Camera sensors {other.cfg.name!r} and {sensor.cfg.name!r} look through the "
                    f"camera {sensor.camera_name!r}, but {field} is {values[0]!r} for the one and "
                    f"{values[1]!r} for the other. Give both the same, or one a camera of its own "
                    "(camera_name=None, with parent_body, pos and quat)."
                )
