"""Reward terms about feet: how long and how high they swing, how they land, whether they slip.

Columns of different sources (contacts, heights, sites) are multiplied with each other, so that all
of them have to list the feet in one order. That is checked when the terms are built.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import accepts_older_params
from mjlab.envs.mdp._checks import require_command
from mjlab.envs.mdp._indexing import columns
from mjlab.managers.build_checks import checked_when_built
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.tasks.velocity.mdp._shared import if_commanded, log_metric, masked_mean
from mjlab.tasks.velocity.mdp.sensor_checks import (
    Source,
    check_air_time_sensor,
    check_feet_sensor,
    check_landing_sensor,
    check_same_feet,
    contact_columns,
    height_columns,
    site_columns,
)

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.reward_manager import RewardTermCfg

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def _check_air_time(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    threshold_min: float = 0.05,
    threshold_max: float = 0.5,
    command_name: str | None = None,
    **_: Any,
) -> None:
    check_air_time_sensor(env, sensor_name)
    require_command(env, command_name)
    if threshold_min >= threshold_max:
        raise ValueError(
            f"threshold_min is {threshold_min} and threshold_max is {threshold_max}; no air time "
            "is between them."
        )


@checked_when_built(_check_air_time)
def feet_air_time(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    threshold_min: float = 0.05,
    threshold_max: float = 0.5,
    command_name: str | None = None,
    command_threshold: float = 0.5,
) -> torch.Tensor:
    """Number of feet that have been in the air for between `threshold_min` and `threshold_max` (s).

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        threshold_min: Air times up to this do not count.
        threshold_max: Air times from this on do not count.
        command_name: Velocity command without which there is no reward; None: always.
        command_threshold: Commanded motion above which there is a reward.
    """
    air_time = env.scene[sensor_name].data.current_air_time
    log_metric(env, "air_time_mean", masked_mean(air_time, air_time > 0.0))
    swinging = (air_time > threshold_min) & (air_time < threshold_max)
    return if_commanded(swinging.sum(dim=1).float(), env, command_name, command_threshold)


def _check_clearance(
    env: ManagerBasedRlEnv,
    height_sensor_name: str,
    command_name: str | None = None,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    require_command(env, command_name)
    heights = f"The height sensor {height_sensor_name!r}", height_columns(env, height_sensor_name)
    check_same_feet(env, heights, ("the selection of sites", site_columns(env, asset_cfg)))


@accepts_older_params
@checked_when_built(_check_clearance)
def feet_clearance(
    env: ManagerBasedRlEnv,
    target_height: float,
    height_sensor_name: str,
    command_name: str | None = None,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Distance of moving feet from the height at which they should move (m^2/s):

        sum over feet of |height - target_height| * |v_xy|

    A foot that stands does not move, so that its height costs nothing.

    Args:
        env: The environment.
        target_height: Height above the ground at which feet should swing, in metres.
        height_sensor_name: Height sensor with one frame for each foot.
        command_name: Velocity command without which there is no cost; None: always.
        command_threshold: Commanded motion above which there is a cost.
        asset_cfg: Entity, and the sites of the feet in the order of the sensor's frames.
    """
    miss = env.scene[height_sensor_name].data.heights - target_height
    return clearance_cost(env, miss, command_name, command_threshold, asset_cfg)


def clearance_cost(
    env: ManagerBasedRlEnv,
    miss: torch.Tensor,
    command_name: str | None,
    command_threshold: float,
    asset_cfg: SceneEntityCfg,
) -> torch.Tensor:
    """Return the cost of feet that miss their height by `miss` (m), (N, feet), while they move."""
    cost = (miss.abs() * _site_speed(env, asset_cfg)).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


@accepts_older_params
class feet_swing_height:
    """Cost of landing after a swing that was too low or too high: `(peak / target - 1)^2`.

    The peak is the greatest height (m) of the foot since it left the ground, and the cost is that
    of the feet that land in this step, where motion is commanded.

    Params:
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        height_sensor_name: Height sensor with one frame for each foot, in the same order.
        target_height: Height that a swing should reach, in metres.
        command_name: The velocity command.
        command_threshold: Commanded motion above which there is a cost.

    Raises, when built: `ValueError` for sensors that do not exist, or list other feet.
    """

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        contact = params["sensor_name"]
        require_command(env, params["command_name"])
        check_air_time_sensor(env, contact)
        check_feet_sensor(env, contact)
        if not params["target_height"] > 0.0:
            raise ValueError(
                f"target_height is {params['target_height']!r}; heights are compared with it, so "
                "it has to be positive."
            )
        feet = contact_columns(env, contact)
        contacts = f"The contact sensor {contact!r}", feet
        self._check_feet(env, contacts, self._height_columns(env, params))
        self.peak_heights = torch.zeros(
            env.num_envs, len(feet), dtype=torch.float32, device=env.device
        )

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        sensor_name: str,
        height_sensor_name: str,
        target_height: float,
        command_name: str,
        command_threshold: float,
    ) -> torch.Tensor:
        """Update the peak heights, and return the cost of landings in this step, (N,)."""
        heights = env.scene[height_sensor_name].data.heights
        cost = self.landing_cost(env, sensor_name, heights, target_height)
        return if_commanded(cost, env, command_name, command_threshold)

    def landing_cost(
        self, env: ManagerBasedRlEnv, sensor_name: str, heights: torch.Tensor, target_height: float
    ) -> torch.Tensor:
        """Update the peaks with `heights` (m), (N, feet); return the cost of landings, (N,)."""
        sensor = env.scene[sensor_name]
        peaks = self.peak_heights
        is_swinging = sensor.data.found == 0
        higher = torch.maximum(peaks, heights)
        torch.where(is_swinging, higher, peaks, out=peaks)
        has_landed = sensor.compute_first_contact(dt=env.step_dt)
        log_metric(env, "peak_height_mean", masked_mean(peaks, has_landed))
        miss = (peaks / target_height - 1.0).square_()
        cost = torch.where(has_landed, miss, 0.0).sum(dim=1)
        peaks.masked_fill_(has_landed, 0.0)
        return cost

    def _check_feet(self, env: ManagerBasedRlEnv, contacts: Source, heights: Source) -> None:
        check_same_feet(env, contacts, heights)

    @staticmethod
    def _height_columns(
        env: ManagerBasedRlEnv, params: dict[str, Any]
    ) -> tuple[str, list[tuple[str, int]]]:
        name = params["height_sensor_name"]
        return f"the height sensor {name!r}", height_columns(env, name)

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """Forget the swings that a reset cut off, so that the next episode does not pay for them."""
        self.peak_heights[slice(None) if env_ids is None else env_ids] = 0.0


def _check_slip(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    command_name: str,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    **_: Any,
) -> None:
    require_command(env, command_name)
    check_feet_sensor(env, sensor_name)
    contacts = f"The contact sensor {sensor_name!r}", contact_columns(env, sensor_name)
    check_same_feet(env, contacts, ("the selection of sites", site_columns(env, asset_cfg)))


@checked_when_built(_check_slip)
def feet_slip(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    command_name: str,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> torch.Tensor:
    """Squared horizontal speed of the feet that touch the ground, summed (m^2/s^2).

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet.
        command_name: Velocity command without which there is no cost.
        command_threshold: Commanded motion above which there is a cost.
        asset_cfg: Entity, and the sites of the feet in the order of the sensor's columns.
    """
    in_contact = env.scene[sensor_name].data.found > 0
    speed = _site_speed(env, asset_cfg)
    log_metric(env, "slip_velocity_mean", masked_mean(speed, in_contact))
    cost = torch.where(in_contact, speed.square_(), 0.0).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


def _check_landing(
    env: ManagerBasedRlEnv, sensor_name: str, command_name: str | None = None, **_: Any
) -> None:
    require_command(env, command_name)
    check_landing_sensor(env, sensor_name)


@checked_when_built(_check_landing)
def soft_landing(
    env: ManagerBasedRlEnv,
    sensor_name: str,
    command_name: str | None = None,
    command_threshold: float = 0.05,
) -> torch.Tensor:
    """Force of the ground on the feet that land in this step, summed (N).

    It is the force of the last physics substep, not the peak of the impact.

    Args:
        env: The environment.
        sensor_name: Contact sensor of the feet, with `track_air_time`.
        command_name: Velocity command without which there is no cost; None: always.
        command_threshold: Commanded motion above which there is a cost.
    """
    sensor = env.scene[sensor_name]
    force = torch.linalg.vector_norm(sensor.data.force, dim=-1)
    has_landed = sensor.compute_first_contact(dt=env.step_dt)
    log_metric(env, "landing_force_mean", masked_mean(force, has_landed))
    cost = torch.where(has_landed, force, 0.0).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


def _site_speed(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """Return the horizontal speed of the selected sites, (N, sites), in m/s."""
    asset: Entity = env.scene[asset_cfg.name]
    sites = columns(asset_cfg.site_ids, env.device)
    velocity = asset.data.site_lin_vel_w[:, sites]
    # By components: a norm over a last dimension of two takes a CPU longer.
    return velocity[..., 0].square().addcmul_(velocity[..., 1], velocity[..., 1]).sqrt_()
