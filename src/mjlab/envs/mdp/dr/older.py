"""Randomization as releases 1.1 and 1.2 spelled it; reached through `mjlab.compat` only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch

from mjlab.envs.mdp._indexing import resolve_env_ids
from mjlab.envs.mdp.dr._actuator_selection import selected_actuators
from mjlab.envs.mdp.dr._core import FieldRow, randomize
from mjlab.envs.mdp.dr._selection import BODY, GEOM, SITE
from mjlab.envs.mdp.dr._table import TABLE
from mjlab.envs.mdp.dr._terms import ROBOT
from mjlab.managers.model_fields import RecomputeLevel, derived_fields

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg


@dataclass
class FieldSpec:
    """How a field was described to `randomize_field`; kept for packages that build one."""

    entity_type: Literal["dof", "joint", "body", "geom", "site", "actuator"]
    use_address: bool = False
    default_axes: list[int] | None = None
    valid_axes: list[int] | None = None


# Quaternions were randomized component by component.
_QUATERNIONS = {
    row.name: row
    for row in (
        FieldRow("body_iquat", "body_iquat", BODY, "", recompute=RecomputeLevel.set_const),
        FieldRow("geom_quat", "geom_quat", GEOM, ""),
        FieldRow("site_quat", "site_quat", SITE, ""),
    )
}
_FIELDS = (
    "dof_armature",
    "dof_frictionloss",
    "dof_damping",
    "jnt_range",
    "jnt_stiffness",
    "body_mass",
    "body_ipos",
    "geom_friction",
    "geom_pos",
    "geom_rgba",
    "site_pos",
    "qpos0",
)
_ROWS = {
    **{row.field: row for row in TABLE.values() if row.field in _FIELDS},
    **_QUATERNIONS,
}


def randomize_field(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    field: str,
    ranges: Any,
    distribution: str = "uniform",
    operation: str = "abs",
    asset_cfg: SceneEntityCfg | None = None,
    axes: list[int] | None = None,
    shared_random: bool = False,
) -> None:
    """Randomize the model field called `field`; today each field has a function of its own.

    Expands the field if no term has declared it, and recomputes the constants that depend on it.
    Raises `ValueError` for a field it does not know.
    """
    if field not in _ROWS:
        raise ValueError(
            f"randomize_field knows no field {field!r}. Choose one of {sorted(_ROWS)}."
        )
    row = _ROWS[field]
    env.sim.expand_model_fields(row.fields)
    randomize(
        row,
        env,
        env_ids,
        ranges,
        ROBOT if asset_cfg is None else asset_cfg,
        distribution,
        operation,
        axes,
        shared_random,
    )


def _row(field: str) -> FieldRow:
    if field not in _ROWS:
        raise ValueError(
            f"randomize_field knows no field {field!r}. Choose one of {sorted(_ROWS)}."
        )
    return _ROWS[field]


def _fields_of(params: dict[str, Any]) -> tuple[str, ...]:
    row = _row(params["field"])
    return (*row.fields, *derived_fields(row.recompute))


# Which fields an event changes depends on its parameters here, so the event manager asks.
setattr(randomize_field, "model_fields", _fields_of)  # noqa: B010
setattr(randomize_field, "recompute", lambda params: _row(params["field"]).recompute)  # noqa: B010


def sync_actuator_delays(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    lag_range: tuple[int, int],
    asset_cfg: SceneEntityCfg = ROBOT,
) -> None:
    """Set one lag, drawn per environment, on all delayed actuators of the selection.

    Args:
        lag_range: Smallest and largest lag (physics substeps), both included.
    """
    low, high = int(lag_range[0]), int(lag_range[1])
    if not 0 <= low <= high:
        raise ValueError(f"lag_range must be 0 <= smallest <= largest, got {tuple(lag_range)}.")
    rows = resolve_env_ids(env, env_ids)
    lags = torch.randint(low, high + 1, (len(rows),), device=env.device)
    for selected in selected_actuators(env, rows, asset_cfg):
        if selected.actuator.has_delay:
            selected.actuator.set_lags(lags, rows)
