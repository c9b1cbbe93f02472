"""Event terms other than domain randomization (`mjlab.envs.mdp.dr`): resets, pushes, forces.

Ranges over poses and twists are dicts with keys x, y, z, roll, pitch, yaw; missing keys are (0, 0).
States are written to `qpos` and `qvel`: derived quantities are stale until the next `forward`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.utils.indexing import as_ids, num_selected
from mjlab.utils.lab_api.math import (
    quat_apply,
    quat_apply_inverse,
    quat_from_euler_xyz,
    quat_mul,
    sample_ranges,
    sample_uniform,
)
from mjlab.utils.state import stateful

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.viewer.debug_visualizer import DebugVisualizer

__all__ = [
    "apply_body_impulse",
    "apply_external_force_torque",
    "push_by_setting_velocity",
    "randomize_terrain",
    "reset_joints_by_offset",
    "reset_joints_by_scale",
    "reset_root_state_from_flat_patches",
    "reset_root_state_uniform",
    "reset_scene_to_default",
    "resolve_env_ids",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")
_SE3_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
Se3Ranges = dict[str, tuple[float, float]]

# Impulse timers are sums of float32 timesteps: without a margin an impulse of exactly k steps would
# last k or k + 1 steps, depending on rounding.
_TIME_MARGIN = 1e-6

__getattr__ = older_names(__name__)


def reset_scene_to_default(env: ManagerBasedRlEnv, env_ids: torch.Tensor | None) -> None:
    """Reset all entities to their default state.

    Floating and mocap bases are reset to their default pose plus the environment's origin; other
    fixed bases do not move.
    """
    ids = resolve_env_ids(env, env_ids)
    for entity in env.scene.entities.values():
        # Read from the indexing, because resets are frequent and walking the spec is slow.
        is_mocap = entity.data.indexing.mocap_id is not None
        if is_mocap or not entity.is_fixed_base:
            root = entity.data.default_root_state[ids]
            root[:, :3] += env.scene.env_origins[ids]
            if is_mocap:
                entity.write_mocap_pose_to_sim(root[:, :7], env_ids=ids)
            else:
                entity.write_root_state_to_sim(root, env_ids=ids)
        if entity.is_articulated:
            entity.write_joint_state_to_sim(
                entity.data.default_joint_pos[ids], entity.data.default_joint_vel[ids], env_ids=ids
            )


def reset_root_state_uniform(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    pose_range: Se3Ranges,
    velocity_range: Se3Ranges | None = None,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Reset the root to its default state plus a uniform sample and the environment's origin.

    The orientation is `default * Rz(yaw) Ry(pitch) Rx(roll)`, a rotation about body axes. The
    velocity (linear at the link origin, angular) is in world axes. A mocap base takes only the pose.

    Raises:
        ValueError: the base is fixed and not a mocap body.
    """
    ids = resolve_env_ids(env, env_ids)
    asset: Entity = env.scene[asset_cfg.name]
    pose = _sample_se3_range(pose_range, (len(ids), 6), env.device)
    position = pose[:, :3]
    position += asset.data.default_root_state[ids, :3]
    position += env.scene.env_origins[ids]
    _write_root(asset, asset_cfg.name, ids, pose, velocity_range)


def reset_root_state_from_flat_patches(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    patch_name: str = "spawn",
    pose_range: Se3Ranges | None = None,
    velocity_range: Se3Ranges | None = None,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Reset the root onto a random flat patch of the environment's terrain cell.

    Position: the patch plus a uniform sample, plus the default height in z. Orientation and
    velocity as in `reset_root_state_uniform`, the fallback for terrains without patches called
    `patch_name`.

    Raises:
        ValueError: the base is fixed and not a mocap body.
    """
    pose_range = pose_range or {}
    terrain = env.scene.terrain
    patches = None if terrain is None else terrain.flat_patches.get(patch_name)
    levels = None if terrain is None else terrain.terrain_levels
    types = None if terrain is None else terrain.terrain_types
    if patches is None or levels is None or types is None:
        reset_root_state_uniform(env, env_ids, pose_range, velocity_range, asset_cfg)
        return
    ids = resolve_env_ids(env, env_ids)
    asset: Entity = env.scene[asset_cfg.name]
    picks = torch.randint(patches.shape[2], (len(ids),), device=env.device)
    patch = patches[levels[ids], types[ids], picks]
    pose = _sample_se3_range(pose_range, (len(ids), 6), env.device)
    pose[:, :3] += patch
    pose[:, 2] += asset.data.default_root_state[ids, 2]
    _write_root(asset, asset_cfg.name, ids, pose, velocity_range)


def reset_joints_by_offset(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    position_range: tuple[float, float],
    velocity_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Reset joints to their defaults plus uniform offsets, clamped to the soft position limits.

    Args:
        position_range: Bounds of the position offset (rad or m).
        velocity_range: Bounds of the velocity offset (rad/s or m/s).
    """
    _reset_joints(env, env_ids, position_range, velocity_range, asset_cfg, torch.add)


def reset_joints_by_scale(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    position_range: tuple[float, float],
    velocity_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Reset joints to their defaults times uniform factors, clamped to the soft position limits.

    Joints with a default of 0 stay at 0; use `reset_joints_by_offset` to move them.

    Args:
        position_range: Bounds of the factor of the default positions.
        velocity_range: Bounds of the factor of the default velocities.
    """
    _reset_joints(env, env_ids, position_range, velocity_range, asset_cfg, torch.mul)


def _reset_joints(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    position_range: tuple[float, float],
    velocity_range: tuple[float, float],
    asset_cfg: SceneEntityCfg,
    combine: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
) -> None:
    """Reset joints to `combine(defaults, uniform samples)`, clamped to the soft position limits."""
    ids = resolve_env_ids(env, env_ids)
    asset: Entity = env.scene[asset_cfg.name]
    data, joints = asset.data, columns_of(asset_cfg, "joint", env)
    position = data.default_joint_pos[ids][:, joints]
    position = combine(position, sample_uniform(*position_range, position.shape, env.device))
    limits = data.soft_joint_pos_limits[ids][:, joints]
    position.clamp_(min=limits[..., 0], max=limits[..., 1])
    velocity = data.default_joint_vel[ids][:, joints]
    velocity = combine(velocity, sample_uniform(*velocity_range, velocity.shape, env.device))
    asset.write_joint_state_to_sim(position, velocity, joint_ids=joints, env_ids=ids)


def randomize_terrain(env: ManagerBasedRlEnv, env_ids: torch.Tensor | None) -> None:
    """Move environments to a random row and column of a generated terrain.

    Does nothing without a terrain. Place this term before terms that write root states, because
    those read the new origins.
    """
    if env.scene.terrain is not None:
        env.scene.terrain.randomize_env_origins(resolve_env_ids(env, env_ids))


def push_by_setting_velocity(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    velocity_range: Se3Ranges,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Add a uniform sample to the root's velocity: linear (m/s) and angular (rad/s), world axes.

    The sample is added to `qvel`, the velocity at the end of the last substep, so that a push
    changes the velocity by exactly the sample.

    Raises:
        ValueError: the base is fixed.
    """
    ids = resolve_env_ids(env, env_ids)
    asset: Entity = env.scene[asset_cfg.name]
    if asset.is_fixed_base:
        raise ValueError(
            f"push_by_setting_velocity: expected an entity with a free joint, got {asset_cfg.name!r} "
            "with a fixed base."
        )
    change = _sample_se3_range(velocity_range, (len(ids), 6), env.device)
    indexing, sim_data = asset.data.indexing, env.sim.data
    # The angular velocity of a free joint is in the body frame.
    quat = sim_data.qpos[ids[:, None], indexing.free_joint_q_adr[3:7]]
    change[:, 3:] = quat_apply_inverse(quat, change[:, 3:])
    sim_data.qvel[ids[:, None], indexing.free_joint_v_adr] += change


def apply_external_force_torque(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    force_range: tuple[float, float],
    torque_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
) -> None:
    """Apply a uniformly sampled force (N) and torque (N m), world axes, to bodies.

    The wrench acts at the bodies' centers of mass until it is overwritten or the environment resets.
    """
    ids = resolve_env_ids(env, env_ids)
    asset: Entity = env.scene[asset_cfg.name]
    shape = (
        len(ids),
        num_selected(columns_of(asset_cfg, "body", env), len(asset.data.indexing.body_ids)),
        3,
    )
    forces = sample_uniform(*force_range, shape, env.device)
    torques = sample_uniform(*torque_range, shape, env.device)
    asset.write_external_wrench_to_sim(
        forces, torques, env_ids=ids, body_ids=columns_of(asset_cfg, "body", env)
    )


@stateful
class apply_body_impulse:
    """Pushes bodies with random wrenches on per-environment timers (mode "step").

    Each environment alternates between a pause of `cooldown_s`, which comes first, and a wrench
    for `duration_s`, i.e. for `ceil(duration / step_dt)` environment steps.

    Params:
        force_range: Bounds of each force component (N), world axes.
        torque_range: Bounds of each torque component (N m), world axes.
        duration_s: Bounds of the impulse duration (s).
        cooldown_s: Bounds of the pause (s); read when the term is built.
        asset_cfg: Entity and bodies.
        body_point_offset: Point of application relative to the body's center of mass, in the link
            frame; adds a torque. Default: the center of mass.
        viz_cfg: Visualization of active impulses: a mapping or object with fields of `VizCfg`.
    """

    @dataclass
    class VizCfg:
        """Visualization of active impulses: one arrow per body."""

        rgba: tuple[float, float, float, float] = (0.9, 0.2, 0.8, 0.9)
        """Color of arrows."""
        scale: float = 0.005
        """Length of arrows per force (m/N)."""
        width: float = 0.015
        """Width of arrows (m)."""
        min_force: float = 1.0
        """Minimum force to draw (N)."""

    _transient = {"_asset", "_viz", "_bodies", "_num_bodies", "_cooldown_s", "_offset"}

    def __init__(self, cfg: Any, env: ManagerBasedRlEnv) -> None:
        params = cfg.params
        self._env = env
        self._asset_cfg: SceneEntityCfg = params["asset_cfg"]
        self._asset: Entity = env.scene[self._asset_cfg.name]
        self._bodies = columns_of(self._asset_cfg, "body", env)
        self._num_bodies = num_selected(
            columns_of(self._asset_cfg, "body", env), self._asset.num_bodies
        )
        self._cooldown_s = tuple(params["cooldown_s"])
        self._offset = params.get("body_point_offset")
        # A mapping or any object may define a subset of the fields.
        viz = params.get("viz_cfg")
        names = [field.name for field in fields(self.VizCfg)]
        if not isinstance(viz, Mapping):
            viz = {name: getattr(viz, name) for name in names if hasattr(viz, name)}
        self._viz = self.VizCfg(**{name: viz[name] for name in names if name in viz})
        self._remaining = torch.zeros(env.num_envs, dtype=torch.float32, device=env.device)
        self._active = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self._cooldown = sample_uniform(*self._cooldown_s, (env.num_envs,), env.device)

    def __call__(
        self,
        env: ManagerBasedRlEnv,
        env_ids: torch.Tensor | None,
        force_range: tuple[float, float],
        torque_range: tuple[float, float],
        duration_s: tuple[float, float],
        cooldown_s: tuple[float, float],
        asset_cfg: SceneEntityCfg,
        body_point_offset: tuple[float, float, float] | None = None,
        viz_cfg: Any = None,
    ) -> None:
        """Advance all timers by one environment step; start and end impulses."""
        self._remaining -= env.step_dt
        expired = (self._active & (self._remaining <= _TIME_MARGIN)).nonzero().flatten()
        if len(expired) > 0:
            self._end(expired)
            self._cooldown[expired] = sample_uniform(*self._cooldown_s, (len(expired),), env.device)
        self._cooldown -= env.step_dt
        ready = ~self._active & (self._cooldown <= _TIME_MARGIN)
        ids = ready.nonzero().flatten()
        if len(ids) == 0:
            return
        shape = (len(ids), self._num_bodies, 3)
        force = sample_uniform(*force_range, shape, env.device)
        torque = sample_uniform(*torque_range, shape, env.device)
        if body_point_offset is not None:
            arm = self._arms(ids, body_point_offset)
            torque += torch.linalg.cross(arm, force)
        self._asset.write_external_wrench_to_sim(force, torque, env_ids=ids, body_ids=self._bodies)
        self._remaining[ids] = sample_uniform(*duration_s, (len(ids),), env.device)
        self._cooldown[ids] = sample_uniform(*self._cooldown_s, (len(ids),), env.device)
        self._active[ids] = True

    def reset(self, env_ids: torch.Tensor | slice | None = None) -> None:
        """End the impulses of `env_ids` (None: all) and start a pause."""
        mask = torch.zeros_like(self._active)
        mask[slice(None) if env_ids is None else env_ids] = True
        ids = mask.nonzero().flatten()
        self._cooldown[ids] = sample_uniform(*self._cooldown_s, (len(ids),), self._env.device)
        active = (mask & self._active).nonzero().flatten()
        if len(active) > 0:
            self._end(active)

    def debug_vis(self, visualizer: DebugVisualizer) -> None:
        """Draw an arrow per active force."""
        data = self._asset.data
        visualizer.add_legend(self._viz.rgba, "applied force")
        for env_idx in visualizer.get_env_indices(self._env.num_envs):
            if not self._active[env_idx]:
                continue
            start = data.body_com_pos_w[env_idx, self._bodies]
            if self._offset is not None:
                ids = torch.tensor([env_idx], device=self._env.device)
                start = start + self._arms(ids, self._offset)[0]
            force = data.body_external_force[env_idx, self._bodies]
            for begin, vector in zip(start.cpu().numpy(), force.cpu().numpy(), strict=True):
                if (vector @ vector) ** 0.5 >= self._viz.min_force:
                    end = begin + vector * self._viz.scale
                    visualizer.add_arrow(begin, end, self._viz.rgba, width=self._viz.width)

    def _arms(self, ids: torch.Tensor, offset: tuple[float, float, float]) -> torch.Tensor:
        """Return the offset in world axes, (K, bodies, 3)."""
        # The offset is in the link frame, not in the frame of the principal axes of inertia.
        quat = self._asset.data.body_link_quat_w[ids][:, self._bodies]
        point = torch.tensor(offset, dtype=quat.dtype, device=quat.device)
        return quat_apply(quat, point.expand(*quat.shape[:-1], 3))

    def _end(self, ids: torch.Tensor) -> None:
        shape = (len(ids), self._num_bodies, 3)
        zero = torch.zeros(shape, dtype=torch.float32, device=self._env.device)
        self._asset.write_external_wrench_to_sim(zero, zero, env_ids=ids, body_ids=self._bodies)
        self._active[ids] = False


def resolve_env_ids(env: ManagerBasedRlEnv, env_ids: torch.Tensor | slice | None) -> torch.Tensor:
    """Return environment ids as an int64 tensor.

    Args:
        env_ids: Integer ids, a bool mask, a slice, or None for all.
    """
    return as_ids(env_ids, env.num_envs, env.device)


def _sample_se3_range(
    range_dict: Se3Ranges | None, shape: tuple[int, ...], device: str
) -> torch.Tensor:
    """Sample (..., 6) in the order of the keys. Missing keys are sampled too, from (0, 0)."""
    ranges = range_dict or {}
    unused = [key for key in ranges if key not in _SE3_KEYS]
    if unused:
        warnings.warn(
            f"pose_range, velocity_range: expected keys {_SE3_KEYS}, got {unused}, which are not used.",
            UserWarning,
            stacklevel=3,
        )
    bounds = [ranges.get(key, (0.0, 0.0)) for key in _SE3_KEYS]
    return sample_ranges(bounds, shape[:-1], device)


def _write_root(
    asset: Entity,
    name: str,
    ids: torch.Tensor,
    pose: torch.Tensor,
    velocity_range: Se3Ranges | None,
) -> None:
    """Write positions and Euler angles, (K, 6), and, for a floating base, a sampled velocity."""
    default = asset.data.default_root_state[ids]
    rotation = quat_from_euler_xyz(pose[:, 3], pose[:, 4], pose[:, 5])
    root_pose = torch.cat((pose[:, :3], quat_mul(default[:, 3:7], rotation)), dim=1)
    if asset.data.indexing.mocap_id is not None:
        asset.write_mocap_pose_to_sim(root_pose, env_ids=ids)
        return
    if asset.is_fixed_base:
        raise ValueError(
            f"reset of the root pose: expected an entity with a free joint or a mocap base, got "
            f"{name!r} with a fixed base."
        )
    velocity = _sample_se3_range(velocity_range, (len(ids), 6), str(ids.device))
    velocity += default[:, 7:13]
    # The pose comes first: writing the velocity rotates its angular part into the body frame.
    asset.write_root_link_pose_to_sim(root_pose, env_ids=ids)
    asset.write_root_link_velocity_to_sim(velocity, env_ids=ids)
