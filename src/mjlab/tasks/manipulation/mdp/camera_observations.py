"""Observation terms of images. Channels come first, as networks take them: (N, C, height, width)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import torch

from mjlab.envs.mdp._checks import require_command, require_sensor
from mjlab.managers.build_checks import checked_when_built
from mjlab.sensor import CameraSensor
from mjlab.tasks.manipulation.mdp._shared import multi_cube_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)


def _check_camera(env: ManagerBasedRlEnv, sensor_name: str, data_type: str) -> None:
    cfg = require_sensor(env, sensor_name, CameraSensor).cfg
    if data_type not in cfg.data_types:
        raise ValueError(
            f"The camera {sensor_name!r} has data_types={tuple(cfg.data_types)}; add {data_type!r}."
        )


def _check_rgb(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    _check_camera(env, sensor_name, "rgb")


@checked_when_built(_check_rgb)
def camera_rgb(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Red, green and blue in [0, 1], (N, 3, height, width)."""
    image = _image(env, sensor_name, "rgb")
    return image.permute(0, 3, 1, 2).float().div_(255.0)


def _check_depth(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    cutoff_distance: float,
    min_depth: float = 0.01,
    **_: Any,
) -> None:
    _check_camera(env, sensor_name, "depth")
    if not 0.0 <= min_depth < cutoff_distance:
        raise ValueError(
            f"min_depth is {min_depth} and cutoff_distance is {cutoff_distance}; the first must not "
            "be negative, and has to be smaller than the second."
        )


@checked_when_built(_check_depth)
def camera_depth(
    env: ManagerBasedRlEnv, sensor_name: str, cutoff_distance: float, min_depth: float = 0.01
) -> torch.Tensor:
    """Depth as a share of `cutoff_distance`, in [0, 1], (N, 1, height, width).

    Depth is the distance along the optical axis. What is closer than `min_depth` (m) counts as if
    it were there, and what is further than `cutoff_distance` (m) as if it were at that. So does the
    background, for which the camera reports a depth of 0.
    """
    depth = _image(env, sensor_name, "depth").permute(0, 3, 1, 2)
    share = depth.clamp(min_depth, cutoff_distance).div_(cutoff_distance)
    # Written so that NaN, too, is background.
    return torch.where(depth > 0.0, share, 1.0)


def _check_segmentation(env: ManagerBasedRlEnv, sensor_name: str, **_: Any) -> None:
    _check_camera(env, sensor_name, "segmentation")


@checked_when_built(_check_segmentation)
def camera_segmentation(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Id and type of the object at each pixel, (N, 2, height, width) int32; -1, -1: background."""
    return _image(env, sensor_name, "segmentation").permute(0, 3, 1, 2)


def _check_mask(env: ManagerBasedRlEnv, sensor_name: str, command_name: str, **_: Any) -> None:
    _check_camera(env, sensor_name, "segmentation")
    require_command(env, command_name)
    multi_cube_command(env, command_name)


@checked_when_built(_check_mask)
def camera_target_cube_mask(
    env: ManagerBasedRlEnv, sensor_name: str, command_name: str
) -> torch.Tensor:
    """1 where the wanted object is seen, else 0, (N, 1, height, width).

    Raises:
        TypeError: the command is no `MultiCubeLiftingCommand`.
    """
    wanted = multi_cube_command(env, command_name).target_geom_ids
    ids, types = _image(env, sensor_name, "segmentation").unbind(dim=-1)
    is_wanted = (ids.unsqueeze(-1) == wanted[:, None, None, :]).any(dim=-1)
    return (is_wanted & (types == _GEOM)).float().unsqueeze(1)


def _image(env: ManagerBasedRlEnv, sensor_name: str, data_type: str) -> torch.Tensor:
    image = getattr(env.scene[sensor_name].data, data_type)
    if image is None:
        raise ValueError(
            f"The camera {sensor_name!r} gives no {data_type}; add {data_type!r} to its data_types."
        )
    return image
