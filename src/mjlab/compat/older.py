"""Functions and classes of 1.x releases without a replacement; `mjlab.compat` maps names to them.

The tasks' `mdp` packages export functions of this module, so module-level imports are limited to
`mjlab.envs` and its imports; other imports are inside functions.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np
import torch

from mjlab.actuator import Actuator, ActuatorCfg
from mjlab.compat import older_function
from mjlab.envs.mdp import dr
from mjlab.envs.mdp.dr._core import BODY, GEOM, ROBOT, SITE, FieldTerm, field_term
from mjlab.envs.mdp.dr.actuator import selected_actuators
from mjlab.managers.event_manager import RecomputeLevel
from mjlab.utils.indexing import as_ids

if TYPE_CHECKING:
    import mujoco
    import trimesh

    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.actions import DifferentialIKAction
    from mjlab.managers import EventTermCfg, SceneEntityCfg
    from mjlab.sensor import ContactSensor


@dataclass(kw_only=True)
class DelayedActuatorCfg(ActuatorCfg):
    """Delay around another actuator config. Replaced by the delay fields of `ActuatorCfg`.

    Targets and passive properties are those of `base_cfg`. All targets of a command are delayed,
    independent of `delay_target`.
    """

    target_names_expr: tuple[str, ...] = field(default=(), init=False)
    """Target patterns of `base_cfg`."""
    base_cfg: ActuatorCfg
    """Actuator config to delay."""
    delay_target: Any = "position"
    """Not used."""

    def __post_init__(self) -> None:
        self.target_names_expr = self.base_cfg.target_names_expr
        self.transmission_type = self.base_cfg.transmission_type
        super().__post_init__()

    def build(self, entity: Entity, target_ids: list[int], target_names: list[str]) -> Actuator:
        """Build the actuator of `base_cfg` with this delay."""
        delay = {name: getattr(self, name) for name in vars(self) if name.startswith("delay_")}
        del delay["delay_target"]
        return dataclasses.replace(self.base_cfg, **delay).build(entity, target_ids, target_names)


@dataclass
class FieldSpec:
    """Model field description of `randomize_field`. Unused; for packages that construct it."""

    entity_type: Literal["dof", "joint", "body", "geom", "site", "actuator"]
    use_address: bool = False
    default_axes: list[int] | None = None
    valid_axes: list[int] | None = None


# Randomization of quaternions, component by component.
_COMPONENTS = "Randomize the components of quaternions."
body_iquat = field_term(
    __name__, "body_iquat", BODY, _COMPONENTS, recompute=RecomputeLevel.set_const
)
geom_quat = field_term(__name__, "geom_quat", GEOM, _COMPONENTS)
site_quat = field_term(__name__, "site_quat", SITE, _COMPONENTS)
_FIELDS = (
    "dof_armature dof_frictionloss dof_damping jnt_range jnt_stiffness body_mass body_ipos "
    "geom_friction geom_pos geom_rgba site_pos qpos0"
)
_FIELD_TERMS = {
    **{field: getattr(dr, field) for field in _FIELDS.split()},
    **{"body_iquat": body_iquat, "geom_quat": geom_quat, "site_quat": site_quat},
}


@older_function
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
    """Randomize the model field called `field`. Replaced by one function per field.

    Expands the field if no event has declared it. Raises `ValueError` for an unknown field.
    """
    term = _field_term(field)
    env.sim.expand_model_fields(term.row.fields)
    term(env, env_ids, ranges, asset_cfg or ROBOT, distribution, operation, axes, shared_random)


def use_field_term(event: EventTermCfg) -> None:
    """Replace `randomize_field` by the function of its field, which declares what it changes."""
    event.func = _field_term(event.params.pop("field"))
    event.params.setdefault("operation", "abs")
    if event.params.get("asset_cfg", ROBOT) is None:
        del event.params["asset_cfg"]


def _field_term(field: str) -> FieldTerm:
    if field not in _FIELD_TERMS:
        raise ValueError(
            f"randomize_field: unknown field {field!r}. Available: {sorted(_FIELD_TERMS)}."
        )
    return _FIELD_TERMS[field]


randomize_effort_limits = older_function(
    dr.effort_limits, "randomize_effort_limits", "mjlab.envs.mdp.dr.effort_limits"
)
randomize_encoder_bias = older_function(
    dr.encoder_bias, "randomize_encoder_bias", "mjlab.envs.mdp.dr.encoder_bias"
)
randomize_pd_gains = older_function(dr.pd_gains, "randomize_pd_gains", "mjlab.envs.mdp.dr.pd_gains")


@older_function
def sync_actuator_delays(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    lag_range: tuple[int, int],
    asset_cfg: SceneEntityCfg = ROBOT,
) -> None:
    """Set the same random per-environment lag on all selected delayed actuators.

    Args:
        lag_range: Minimum and maximum lag (physics substeps), inclusive.
    """
    low, high = int(lag_range[0]), int(lag_range[1])
    if not 0 <= low <= high:
        raise ValueError(f"lag_range: expected 0 <= low <= high, got {tuple(lag_range)}.")
    rows = as_ids(env_ids, env.num_envs, env.device)
    lags = torch.randint(low, high + 1, (len(rows),), device=env.device)
    for selected in selected_actuators(env, rows, asset_cfg):
        if selected.actuator.has_delay:
            selected.actuator.set_lags(lags, rows)


class RewardWeightStage(TypedDict):
    """Reward weight, and the number of environment steps after which it applies."""

    step: int
    weight: float


@older_function
def reward_weight(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor,
    reward_name: str,
    weight_stages: list[RewardWeightStage],
) -> torch.Tensor:
    """Set a reward's weight to that of the last stage passed, and return the weight.

    Unlike in `reward_curriculum`, a stage starts one step after its `step`.
    """
    cfg = env.reward_manager.get_term_cfg(reward_name)
    for stage in weight_stages:
        if env.common_step_counter > stage["step"]:
            cfg.weight = stage["weight"]
    return torch.tensor([cfg.weight], dtype=torch.float32)


@older_function
def flat_orientation(
    env: ManagerBasedRlEnv, std: float, asset_cfg: SceneEntityCfg = ROBOT
) -> torch.Tensor:
    """Reward upright orientation of a body: `upright` without terrain sensors."""
    from mjlab.tasks.velocity.mdp.rewards import body_quat, single_body, tilt_of

    quat = body_quat(env.scene[asset_cfg.name].data, single_body(env, asset_cfg))
    return torch.exp(tilt_of(quat) / -(std**2))


@older_function
def disable_collision(geom: Any) -> None:
    """Disable collisions of a spec geom."""
    geom.contype = 0
    geom.conaffinity = 0


@older_function
def update_assets(
    assets: dict[str, Any],
    path: str | Path,
    meshdir: str | None = None,
    glob: str = "*",
    recursive: bool = False,
) -> None:
    """Add the files of a folder to `assets`, with keys `<meshdir>/<file name>`."""
    folder = Path(path)
    for file in folder.rglob(glob) if recursive else folder.glob(glob):
        if file.is_file():
            assets[f"{meshdir}/{file.name}" if meshdir else file.name] = file.read_bytes()


@older_function
def get_assets(meshdir: str) -> dict[str, bytes]:
    """Return an empty dict: the robots use primitive shapes instead of mesh files."""
    return {}


@older_function
def merge_geoms_global(
    mj_model: mujoco.MjModel, mj_data: mujoco.MjData, geom_ids: list[int]
) -> trimesh.Trimesh:
    """Return one mesh of the geoms in the world frame, at the body poses of `mj_data`."""
    import trimesh
    from mjviser.conversions import merge_geoms

    merged: list[trimesh.Trimesh] = []
    for geom_id in geom_ids:
        body_id = mj_model.geom_bodyid[geom_id]
        pose = np.eye(4)
        pose[:3, :3] = mj_data.xmat[body_id].reshape(3, 3)
        pose[:3, 3] = mj_data.xpos[body_id]
        merged.append(merge_geoms(mj_model, [geom_id]).apply_transform(pose))
    mesh = trimesh.util.concatenate(merged)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@older_function
def mujoco_mesh_to_trimesh(
    mj_model: mujoco.MjModel, geom_idx: int, verbose: bool = False
) -> trimesh.Trimesh:
    """Return the mesh of a mesh geom, in the geom's frame; `verbose` has no effect."""
    from mjviser import conversions

    return conversions.mujoco_mesh_to_trimesh(mj_model, geom_idx)


@older_function
def rotation_quat_from_vectors(from_vec: Any, to_vec: Any) -> Any:
    """Return the quaternion (w, x, y, z) of the shortest rotation between two vectors."""
    start = np.asarray(from_vec, dtype=float) / np.linalg.norm(from_vec)
    end = np.asarray(to_vec, dtype=float) / np.linalg.norm(to_vec)
    quat = np.array([1.0 + start @ end, *np.cross(start, end)])
    if quat[0] < 1e-9:
        # Opposite vectors: rotation by pi about any perpendicular axis.
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
        quat = np.array([0.0, *axis])
    return quat / np.linalg.norm(quat)


class Timer:
    """Timer of wall time between ticks (s)."""

    def __init__(self) -> None:
        self._previous = time.time()

    def tick(self) -> float:
        """Return the time since the last tick (s)."""
        now = time.time()
        elapsed, self._previous = now - self._previous, now
        return elapsed


@older_function
def compute_flat_patches(
    noise: np.ndarray,
    vertical_scale: float,
    horizontal_scale: float,
    z_offset: float,
    flat_patch_sampling: dict[str, Any] | None,
    rng: np.random.Generator,
) -> dict[str, np.ndarray] | None:
    """Return flat patches of an integer height field, (number, 3) by name.

    `z_offset` is the height of the field's lowest point.
    """
    from mjlab.terrains.utils import find_flat_patches_from_heightfield

    if flat_patch_sampling is None:
        return None
    heights = (noise - noise.min()) * vertical_scale
    return {
        name: find_flat_patches_from_heightfield(heights, horizontal_scale, z_offset, cfg, rng)
        for name, cfg in flat_patch_sampling.items()
    }


# Attributes of instances.


@dataclass(frozen=True)
class ContactSlot:
    """One field of one primary of a contact sensor."""

    primary_name: str
    """Name of the primary."""
    field_name: str
    """Name of the field."""
    sensor_name: str
    """Name of the MuJoCo sensor of all fields of the primary."""
    sensor: ContactSensor
    """Contact sensor."""
    index: int
    """Index of the primary."""

    @property
    def data_view(self) -> torch.Tensor:
        """Current values, (N, number of slots * field size)."""
        values = self.sensor._split(self.sensor._block(), to_world=False)[self.field_name]
        num_slots = self.sensor.cfg.num_slots
        first = self.index * num_slots
        return values[:, first : first + num_slots].flatten(1)


def contact_slots(sensor: ContactSensor) -> list[ContactSlot]:
    """Return the fields of all primaries, grouped by primary."""
    return [
        ContactSlot(primary, field, f"{sensor.cfg.name}_{primary}", sensor, index)
        for index, primary in enumerate(sensor.primary_names)
        for field in sensor.cfg.fields
    ]


def ik_joint_ids(action: DifferentialIKAction) -> torch.Tensor:
    """Return the ids of the joints driven by the action, (number of joints,)."""
    count = action._entity.num_joints
    return torch.arange(count, device=action.device)[action._columns]
