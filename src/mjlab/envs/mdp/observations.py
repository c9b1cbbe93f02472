"""Observation terms.

The root frame of an entity is the link frame of its root body. Terms may return live views of
simulation memory: the observation manager copies them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.sensor.builtin_sensor import BuiltinSensor
from mjlab.sensor.raycast_sensor import RayCastSensor
from mjlab.sensor.terrain_scan import check_terrain_scan
from mjlab.utils.errors import WrongTypeError, check_exists

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
    """Linear velocity of the root in the root frame (m/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_lin_vel_b


def base_ang_vel(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Angular velocity of the root in the root frame (rad/s), (N, 3)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_ang_vel_b


def projected_gravity(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Unit vector down (world -z) in the root frame, (N, 3). Independent of `opt.gravity`."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.projected_gravity_b


def joint_pos_rel(
    env: ManagerBasedRlEnv,
    biased: bool = False,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Joint positions minus default positions (rad or m), (N, joints).

    Args:
        biased: Add the encoder bias, as in readings of the robot's encoders.
    """
    asset: Entity = env.scene[asset_cfg.name]
    data, joints = asset.data, columns_of(asset_cfg, "joint", env)
    relative = data.joint_pos[:, joints] - data.default_joint_pos[:, joints]
    if biased:
        relative += data.encoder_bias[:, joints]
    return relative


def joint_vel_rel(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Joint velocities minus default velocities (rad/s or m/s), (N, joints)."""
    asset: Entity = env.scene[asset_cfg.name]
    joints = columns_of(asset_cfg, "joint", env)
    return asset.data.joint_vel[:, joints] - asset.data.default_joint_vel[:, joints]


def last_action(env: ManagerBasedRlEnv, action_name: str | None = None) -> torch.Tensor:
    """Last raw action, (N, A), or that of one action term."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_term(action_name).raw_action


def generated_commands(env: ManagerBasedRlEnv, command_name: str) -> torch.Tensor:
    """Command of a command term, (N, ...).

    Raises:
        ValueError: unknown command.
    """
    command = env.command_manager.get_command(command_name)
    if command is None:
        check_exists("command", command_name, env.command_manager.active_terms)
    return command


def builtin_sensor(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Raw value of a MuJoCo sensor, (N, dim), in MuJoCo's units and frames.

    Raises:
        TypeError: the sensor is not a `BuiltinSensor`.
    """
    sensor = env.scene[sensor_name]
    if not isinstance(sensor, BuiltinSensor):
        raise WrongTypeError(
            f"Sensor {sensor_name!r}: expected BuiltinSensor, got {type(sensor).__name__}; use a "
            "MuJoCo sensor, such as 'robot/imu_gyro'."
        )
    return sensor.data


def projected_gravity_from_sensor(env: ManagerBasedRlEnv, sensor_name: str) -> torch.Tensor:
    """Unit vector down in the frame of an up-vector sensor (framezaxis), (N, 3).

    Raises:
        TypeError: the sensor is not a `BuiltinSensor`.
    """
    return -builtin_sensor(env, sensor_name)


def height_scan(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    offset: float = 0.0,
    miss_value: float | None = None,
) -> torch.Tensor:
    """Height of each ray's frame above its hit (m), (N, frames * rays), frame by frame.

    Warns once if the rays miss the ground or meet their robot.

    Args:
        sensor_name: Ray-cast sensor.
        offset: Offset subtracted from the heights of hits (m).
        miss_value: Value of rays without a hit. Default: the sensor's `max_distance`.
    """
    sensor = env.scene[sensor_name]
    if isinstance(sensor, RayCastSensor):
        check_terrain_scan(sensor, env.sim.mj_model)
    data = sensor.data
    if miss_value is None:
        miss_value = sensor.cfg.max_distance
    hit_z = data.hit_pos_w[..., 2].unflatten(1, (-1, sensor.num_rays_per_frame))
    heights = (data.frame_pos_w[..., 2:] - hit_z).flatten(1).sub_(offset)
    return heights.masked_fill_(data.distances < 0.0, miss_value)


__getattr__ = older_names(__name__)
