"""Foot terms of releases 1.1 and 1.2, which read site heights above z = 0 instead of a height sensor."""

from __future__ import annotations

import copy
import warnings
from typing import TYPE_CHECKING, Any

import torch

from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.managers.term_checks import checked_when_built, require_command
from mjlab.tasks.velocity.mdp import rewards as feet_rewards
from mjlab.tasks.velocity.mdp.observations import Source, check_same_feet, site_columns
from mjlab.tasks.velocity.mdp.rewards import if_commanded

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg


_ROBOT = SceneEntityCfg("robot")
_HEIGHT_SENSOR = "foot_height_scan"


def _check_sites(
    env: ManagerBasedRlEnv,
    command_name: str | None = None,
    asset_cfg: SceneEntityCfg = _ROBOT,
    **_: Any,
) -> None:
    require_command(env, command_name)
    site_columns(env, asset_cfg)


@checked_when_built(_check_sites)
def foot_height(env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _ROBOT) -> torch.Tensor:
    """Height of selected sites above z = 0 (m), (N, sites)."""
    sites = columns_of(asset_cfg, "site", env)
    return env.scene[asset_cfg.name].data.site_pos_w[:, sites, 2]


@checked_when_built(_check_sites)
def feet_clearance(
    env: ManagerBasedRlEnv,
    target_height: float,
    command_name: str | None = None,
    command_threshold: float = 0.01,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> torch.Tensor:
    """Distance of moving sites from `target_height` above z = 0 (m^2/s), (N,)."""
    miss = foot_height(env, asset_cfg) - target_height
    return feet_rewards.clearance_cost(env, miss, command_name, command_threshold, asset_cfg)


class feet_swing_height(feet_rewards.feet_swing_height):
    """Penalty at landing for swings with a peak height above z = 0 that is too low or too high."""

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

    def _check_heights(
        self, env: ManagerBasedRlEnv, params: dict[str, Any], contacts: Source
    ) -> None:
        sites = site_columns(env, params["asset_cfg"])
        try:
            check_same_feet(env, contacts, sites)
        except ValueError as error:
            if len(contacts.columns) != len(sites.columns):
                raise
            # Releases 1.1 and 1.2 accept any order.
            warnings.warn(str(error), UserWarning, stacklevel=2)


def offer_sites(template: ManagerBasedRlEnvCfg) -> None:
    """Let packages set foot sites in the velocity template, as in releases 1.1 and 1.2."""
    for term in _height_terms(template):
        term.params = _FeetParams(term.params)
        term.params.template = template


class _FeetParams(dict[str, Any]):
    """Parameters of a template term that accept `asset_cfg` in place of the height sensor.

    Access of `asset_cfg` converts all terms of the template that read the sensor to legacy terms.
    """

    template: ManagerBasedRlEnvCfg | None = None

    def __missing__(self, key: str) -> Any:
        if key != "asset_cfg" or self.template is None:
            raise KeyError(key)
        for term in _height_terms(self.template):
            for name in [name for name, value in term.params.items() if value == _HEIGHT_SENSOR]:
                del term.params[name]
        scene = self.template.scene
        scene.sensors = tuple(cfg for cfg in scene.sensors if cfg.name != _HEIGHT_SENSOR)
        self[key] = SceneEntityCfg("robot", site_names=())
        return self[key]

    def __deepcopy__(self, memo: dict[int, Any]) -> _FeetParams:
        copied = _FeetParams({key: copy.deepcopy(value, memo) for key, value in self.items()})
        # A copied template refers to itself; a separately copied term refers to no template.
        copied.template = memo.get(id(self.template))
        return copied


def _height_terms(template: ManagerBasedRlEnvCfg) -> list[Any]:
    terms: list[Any] = list(template.rewards.values())
    for group in template.observations.values():
        terms += group.terms.values() if group else ()
    return [term for term in terms if term and _HEIGHT_SENSOR in term.params.values()]
