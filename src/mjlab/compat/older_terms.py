"""Foot terms of releases 1.1 and 1.2, which read site heights above z = 0 instead of a height sensor."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import FOOT_SCAN, reads_foot_scan, warn_of_sites
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.tasks.velocity.mdp import observations as foot_observations
from mjlab.tasks.velocity.mdp import rewards as feet_rewards
from mjlab.tasks.velocity.mdp.observations import check_same_feet
from mjlab.tasks.velocity.mdp.rewards import if_commanded, site_speed

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
    from mjlab.managers import RewardTermCfg


_ROBOT = SceneEntityCfg("robot")


def foot_height(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of selected sites above z = 0 (m), (N, sites)."""
    sites = columns_of(asset_cfg, "site", env)
    return env.scene[asset_cfg.name].data.site_pos_w[:, sites, 2]


def feet_clearance(
    env: ManagerBasedRlEnv,
    target_height: float,
    command_name: str | None = None,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> torch.Tensor:
    """Distance of moving sites from `target_height` above z = 0 (m^2/s), (N,)."""
    error = foot_height(env, asset_cfg) - target_height
    cost = (error.abs() * site_speed(env, asset_cfg)).sum(dim=1)
    return if_commanded(cost, env, command_name, command_threshold)


class feet_swing_height(feet_rewards.feet_swing_height):
    """Penalty at landing for swings with a peak height above z = 0 that is too low or too high."""

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        check_same_feet(env, cfg.params["sensor_name"], cfg.params["asset_cfg"])
        feet = len(env.scene[cfg.params["sensor_name"]].primary_names)
        self.peak_heights = torch.zeros(env.num_envs, feet, dtype=torch.float32, device=env.device)

    def __call__(  # ty: ignore[incompatible-method-override]
        self,
        env: ManagerBasedRlEnv,
        sensor_name: str,
        target_height: float,
        command_name: str,
        command_threshold: float,
        asset_cfg: SceneEntityCfg,
    ) -> torch.Tensor:
        """Update peak heights, and return the penalty of landings in this step, (N,)."""
        cost = self.landing_cost(env, sensor_name, foot_height(env, asset_cfg), target_height)
        return if_commanded(cost, env, command_name, command_threshold)


def use_older_foot_terms(cfg: ManagerBasedRlEnvCfg, terms: list[Any]) -> None:
    """Use the terms of releases 1.1 and 1.2 where a config names foot sites instead of a height sensor.

    Packages of these releases fill in the sites of the velocity template, and know no height sensor.
    Sites that are left empty are dropped, unless the term takes them today.

    Args:
        cfg: Environment config, edited in place.
        terms: Terms with a parameter `asset_cfg`.
    """
    named = [term for term in terms if term.params["asset_cfg"].site_names not in ((), [])]
    # Later releases name sites for the clearance only.
    template_is_older = any(
        reads_foot_scan(term) and term.func in (_foot_height, _feet_swing_height) for term in named
    )
    for term in terms:
        is_named = any(term is one for one in named)
        sensor, older = _OLDER_TERMS.get(term.func, ("", None))
        is_unset = sensor not in term.params or (template_is_older and reads_foot_scan(term))
        if is_named and older is not None and is_unset:
            term.params.pop(sensor, None)
            warn_of_sites(term.func.__name__)
            term.func = older
        elif not is_named and "asset_cfg" not in inspect.signature(_call_of(term.func)).parameters:
            del term.params["asset_cfg"]
    if template_is_older:
        scene = cfg.scene
        scene.sensors = tuple(sensor for sensor in scene.sensors if sensor.name != FOOT_SCAN)


def _call_of(func: Any) -> Any:
    return func.__call__ if inspect.isclass(func) else func


_foot_height, _feet_swing_height = foot_observations.foot_height, feet_rewards.feet_swing_height
# Sensor parameter and older term of each foot term.
_OLDER_TERMS: dict[Any, tuple[str, Any]] = {
    _foot_height: ("sensor_name", foot_height),
    _feet_swing_height: ("height_sensor_name", feet_swing_height),
    feet_rewards.feet_clearance: ("height_sensor_name", feet_clearance),
}
