"""Observation terms.

The root of an entity is the frame of its root body's link. Terms may return live views of the
simulation: the observation manager copies them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.sensor.builtin_sensor import BuiltinSensor
from mjlab.utils.errors import WrongTypeError, check_exists
from mjlab.utils.indexing import as_columns

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "base_ang_vel",
    "base_lin_vel",
    "builtin_sensor",
    "generated_commands",
    "height_scan",
    "joint_pos_rel",
    "joint_vel_rel",
    "last_action",
    "projected_gravity",
    "projected_gravity_from_sensor",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def base_lin_vel(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Linear velocity of the root in its own frame (m/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_lin_vel_b


def base_ang_vel(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Angular velocity of the root in its own frame (rad/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_ang_vel_b


def projected_gravity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Unit vector down (world -z) in the root's frame, (N, 3); the gravity setting is ignored."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.projected_gravity_b


def joint_pos_rel(
    env: ManagerBasedRlEnv,
    biased: bool = False,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Joint positions minus default positions (rad or m), (N, joints).

    Args:
        biased: Add the encoder bias, as a robot's own encoders would.
    """
    asset: Entity = env.scene[asset_cfg.name]
    data, joints = asset.data, as_columns(asset_cfg.joint_ids, env.device)
    relative = data.joint_pos[:, joints] - data.default_joint_pos[:, joints]
    if biased:
        relative += data.encoder_bias[:, joints]
    return relative


def joint_vel_rel(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Joint velocities minus default velocities (rad/s or m/s), (N, joints)."""
    asset: Entity = env.scene[asset_cfg.name]
    joints = as_columns(asset_cfg.joint_ids, env.device)
    return asset.data.joint_vel[:, joints] - asset.data.default_joint_vel[:, joints]


def last_action(env: ManagerBasedRlEnv, action_name: str | None = None) -> torch.Tensor:
    """Last raw action: all of it (N, A), or that of one action term."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_term(action_name).raw_action


def generated_commands(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """The command of a command term, (N, ...).

    Raises:
        ValueError: there is no such command.
    """
    command = env.command_manager.get_command(command_name)
    if command is None:
        check_exists("command", command_name, env.command_manager.active_terms)
    return command


def builtin_sensor(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Raw value of a MuJoCo sensor, (N, dim), in MuJoCo's units and frames.

    Raises:
        TypeError: the sensor is of another kind.
    """
    return _builtin(env, sensor_name).data


def projected_gravity_from_sensor(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Unit vector down in a sensor's frame, (N, 3), from a sensor of the up vector (framezaxis).

    Raises:
        TypeError: the sensor is no MuJoCo sensor.
    """
    return -_builtin(env, sensor_name).data


def height_scan(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    offset: float = 0.0,
    miss_value: float | None = None,
) -> torch.Tensor:
    """Height of each ray's frame above what the ray hits (m), (N, frames * rays), frame by frame.

    Args:
        sensor_name: A ray cast sensor.
        offset: Subtracted from heights of hits.
        miss_value: Value of rays that hit nothing; the sensor's `max_distance` by default.
    """
    sensor = env.scene[sensor_name]
    data = sensor.data
    if miss_value is None:
        miss_value = sensor.cfg.max_distance
    hit_z = data.hit_pos_w[..., 2].unflatten(1, (-1, sensor.num_rays_per_frame))
    heights = (data.frame_pos_w[..., 2:] - hit_z).flatten(1).sub_(offset)
    return heights.masked_fill_(data.distances < 0.0, miss_value)


def _builtin(env: ManagerBasedRlEnv, sensor_name: str) -> BuiltinSensor:
    sensor = env.scene[sensor_name]
    if not isinstance(sensor, BuiltinSensor):
        raise WrongTypeError(
            f"{sensor_name!r} is a {type(sensor).__name__}, not a BuiltinSensor. Give the name of "
            "a MuJoCo sensor, such as 'robot/imu_gyro'."
        )
    return sensor


__getattr__ = older_names(__name__)
