"""Names of earlier 1.x releases that have no successor; reached by name, through the table.

The `mdp` packages of the tasks export functions from here, so imports at the top are limited to
`mjlab.envs` and what it imports; the rest is imported where it is used.
"""

from __future__ import annotations

import dataclasses
import time
from abc import ABCMeta
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np
import torch

from mjlab.actuator.actuator import Actuator, ActuatorCfg
from mjlab.envs.mdp._indexing import resolve_env_ids
from mjlab.envs.mdp.dr._actuator_selection import selected_actuators
from mjlab.envs.mdp.dr._core import FieldRow, randomize
from mjlab.envs.mdp.dr._selection import BODY, GEOM, SITE
from mjlab.envs.mdp.dr._table import TABLE
from mjlab.envs.mdp.dr._terms import ROBOT
from mjlab.managers.model_fields import RecomputeLevel, derived_fields

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg


class DelayedActuatorCfg:
    """`DelayedActuatorCfg(base_cfg=..., delay_max_lag=...)` returns `base_cfg` with these delays.

    Today every actuator config takes `delay_min_lag` and so on itself. The whole command is
    delayed, whichever part `delay_target` names.
    """

    def __new__(  # type: ignore[misc]
        cls,
        *,
        base_cfg: ActuatorCfg,
        delay_target: Any = "position",
        delay_min_lag: int = 0,
        delay_max_lag: int = 1,
        delay_hold_prob: float = 0.0,
        delay_update_period: int = 0,
        delay_per_env_phase: bool = True,
    ) -> ActuatorCfg:
        return dataclasses.replace(
            base_cfg,
            delay_min_lag=delay_min_lag,
            delay_max_lag=delay_max_lag,
            delay_hold_prob=delay_hold_prob,
            delay_update_period=delay_update_period,
            delay_per_env_phase=delay_per_env_phase,
        )


class _HasDelay(ABCMeta):
    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, Actuator) and instance.has_delay


class DelayedActuator(Actuator, metaclass=_HasDelay):
    """Any actuator that has a delay is an instance of this."""


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
    row = _row(field)
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


class RewardWeightStage(TypedDict):
    """A reward weight, and the number of environment steps after which it holds."""

    step: int
    weight: float


def reward_weight(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    reward_name: str,
    weight_stages: list[RewardWeightStage],
) -> torch.Tensor:
    """Set a reward's weight to that of the last stage whose step has been passed, and return it.

    Unlike `reward_curriculum`, a stage starts one step after its `step`.
    """
    cfg = env.reward_manager.get_term_cfg(reward_name)
    for stage in weight_stages:
        if env.common_step_counter > stage["step"]:
            cfg.weight = stage["weight"]
    return torch.tensor([cfg.weight])


def flat_orientation(
    env: ManagerBasedRlEnv, std: float, asset_cfg: SceneEntityCfg = ROBOT
) -> torch.Tensor:
    """Reward a body that stands upright: `upright` without terrain sensors."""
    from mjlab.tasks.velocity.mdp._shared import single_body, tilt_of

    asset: Entity = env.scene[asset_cfg.name]
    body = single_body(env, asset_cfg)
    data = asset.data
    quat = data.root_link_quat_w if body is None else data.body_link_quat_w[:, body]
    return torch.exp(tilt_of(quat) / -(std**2))


def disable_collision(geom: Any) -> None:
    """Switch off the contacts of a geom of a spec."""
    geom.contype = 0
    geom.conaffinity = 0


def update_assets(
    assets: dict[str, Any],
    path: str | Path,
    meshdir: str | None = None,
    glob: str = "*",
    recursive: bool = False,
) -> None:
    """Add the contents of the files in a folder to `assets`, by `<meshdir>/<file name>`."""
    folder = Path(path)
    for file in folder.rglob(glob) if recursive else folder.glob(glob):
        if file.is_file():
            assets[f"{meshdir}/{file.name}" if meshdir else file.name] = file.read_bytes()


def get_assets(meshdir: str) -> dict[str, bytes]:
    """Return the mesh files of a robot by path: none, as ours are drawn with primitive shapes."""
    return {}


def rotation_quat_from_vectors(from_vec: Any, to_vec: Any) -> Any:
    """Return the quaternion (w, x, y, z) of the shortest rotation between two vectors."""
    start = np.asarray(from_vec, dtype=float) / np.linalg.norm(from_vec)
    end = np.asarray(to_vec, dtype=float) / np.linalg.norm(to_vec)
    quat = np.array([1.0 + start @ end, *np.cross(start, end)])
    if quat[0] < 1e-9:
        # Opposite vectors: half a turn about any axis across them.
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        quat = np.array([0.0, *axis])
    return quat / np.linalg.norm(quat)


class Timer:
    """Measures wall time between ticks, in seconds."""

    def __init__(self) -> None:
        self._previous = time.time()

    def tick(self) -> float:
        """Return the time since the last tick."""
        now = time.time()
        elapsed, self._previous = now - self._previous, now
        return elapsed
