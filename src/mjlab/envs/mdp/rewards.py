"""Unweighted reward terms, (N,)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from mjlab.compat import older_names
from mjlab.managers.scene_entity_config import SceneEntityCfg, columns_of
from mjlab.utils.indexing import as_columns
from mjlab.utils.lab_api.string import resolve_matching_names_values

if TYPE_CHECKING:
    from mjlab.entity import Entity
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.reward_manager import RewardTermCfg

__all__ = [
    "action_acc_l2",
    "action_l2",
    "action_rate_l2",
    "ang_vel_xy_l2",
    "base_height_l2",
    "electrical_power_cost",
    "flat_orientation_l2",
    "is_alive",
    "is_terminated",
    "joint_acc_l2",
    "joint_deviation_l1",
    "joint_pos_limits",
    "joint_torques_l2",
    "joint_vel_l1",
    "joint_vel_l2",
    "lin_vel_z_l2",
    "posture",
    "self_collision_cost",
    "undesired_contacts",
]

_DEFAULT_ASSET_CFG = SceneEntityCfg("robot")


def is_alive(env: ManagerBasedRlEnv) -> torch.Tensor:
    """1 unless the episode terminated. Time-outs count as alive."""
    return (~env.termination_manager.terminated).float()


def is_terminated(env: ManagerBasedRlEnv) -> torch.Tensor:
    """1 if the episode terminated. Time-outs do not count."""
    return env.termination_manager.terminated.float()


def joint_torques_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of squared actuator forces, before the gear, over the selected **actuators**."""
    asset: Entity = env.scene[asset_cfg.name]
    chosen = asset.data.indexing.force_columns(columns_of(asset_cfg, "actuator", env))
    forces = asset.data.actuator_force[:, as_columns(chosen, env.device)]
    return forces.square().sum(dim=1)


def joint_vel_l1(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of absolute joint velocities."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.joint_vel[:, columns_of(asset_cfg, "joint", env)].abs().sum(dim=1)


def joint_vel_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of squared joint velocities."""
    asset: Entity = env.scene[asset_cfg.name]
    velocities = asset.data.joint_vel[:, columns_of(asset_cfg, "joint", env)]
    return velocities.square().sum(dim=1)


def joint_acc_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of squared joint accelerations."""
    asset: Entity = env.scene[asset_cfg.name]
    accelerations = asset.data.joint_acc[:, columns_of(asset_cfg, "joint", env)]
    return accelerations.square().sum(dim=1)


def joint_deviation_l1(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of absolute deviations of the joints from their default positions (rad or m)."""
    asset: Entity = env.scene[asset_cfg.name]
    data, joints = asset.data, columns_of(asset_cfg, "joint", env)
    return (data.joint_pos[:, joints] - data.default_joint_pos[:, joints]).abs().sum(dim=1)


def action_l2(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Sum of squares of the raw action."""
    return env.action_manager.action.square().sum(dim=1)


def action_rate_l2(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Sum of squared changes of the raw action since the last step.

    The previous action is zero after a reset, so the first value of an episode is the squared
    action.
    """
    actions = env.action_manager
    return (actions.action - actions.prev_action).square().sum(dim=1)


def action_acc_l2(env: ManagerBasedRlEnv) -> torch.Tensor:
    """Sum of squared second differences of the raw action."""
    actions = env.action_manager
    second = actions.action - 2.0 * actions.prev_action + actions.prev_prev_action
    return second.square().sum(dim=1)


def joint_pos_limits(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Sum of soft joint limit violations (rad or m)."""
    asset: Entity = env.scene[asset_cfg.name]
    joints = columns_of(asset_cfg, "joint", env)
    position = asset.data.joint_pos[:, joints]
    limits = asset.data.soft_joint_pos_limits[:, joints]
    below = (limits[..., 0] - position).clamp_(min=0.0)
    above = (position - limits[..., 1]).clamp_(min=0.0)
    return below.add_(above).sum(dim=1)


def flat_orientation_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Squared horizontal component of projected gravity: sin^2 of the root's tilt."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.projected_gravity_b[:, :2].square().sum(dim=1)


def lin_vel_z_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Squared velocity of the root link along its z axis (m^2/s^2)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG
) -> torch.Tensor:
    """Squared angular velocity of the root link about its x and y axes (rad^2/s^2)."""
    asset: Entity = env.scene[asset_cfg.name]
    return asset.data.root_link_ang_vel_b[:, :2].square().sum(dim=1)


def base_height_l2(
    env: ManagerBasedRlEnv,
    target_height: float,
    asset_cfg: SceneEntityCfg = _DEFAULT_ASSET_CFG,
    sensor_name: str | None = None,
) -> torch.Tensor:
    """Squared difference of the root's height and `target_height` (m^2).

    Args:
        target_height: Height of the root link's origin (m).
        asset_cfg: Entity.
        sensor_name: Ray-cast sensor of the ground. The height is that above the mean of its hits, or
            above z = 0 if no ray hits. None: above z = 0 of the world.
    """
    asset: Entity = env.scene[asset_cfg.name]
    height = asset.data.root_link_pos_w[:, 2]
    if sensor_name is not None:
        data = env.scene[sensor_name].data
        is_hit = data.distances >= 0.0
        ground = torch.where(is_hit, data.hit_pos_w[..., 2], 0.0).sum(dim=1)
        height = height - ground / is_hit.sum(dim=1).clamp(min=1)
    return (height - target_height).square()


def undesired_contacts(
    env: ManagerBasedRlEnv, sensor_name: str, force_threshold: float = 1.0
) -> torch.Tensor:
    """Number of primaries of a contact sensor, such as thighs, in contact.

    With a force history: primaries with a force above `force_threshold` (N) in any substep of the
    history. With forces: those above it in the last substep. Without: all primaries in contact.
    """
    sensor = env.scene[sensor_name]
    data, slots = sensor.data, sensor.cfg.num_slots
    if data.force_history is not None:
        hits = (data.force_history.norm(dim=-1) > force_threshold).any(dim=2)
    elif data.force is not None:
        hits = data.force.norm(dim=-1) > force_threshold
    else:
        hits = data.found > 0
    return hits.unflatten(1, (-1, slots)).any(dim=2).sum(dim=1).float()


def self_collision_cost(
    env: ManagerBasedRlEnv, sensor_name: str, force_threshold: float = 10.0
) -> torch.Tensor:
    """Number of unwanted contacts of the robot with itself or with the ground.

    With a force history: number of substeps in the history with any force above `force_threshold`
    (N). Without one: number of contacts.
    """
    data = env.scene[sensor_name].data
    if data.force_history is None:
        return data.found.sum(dim=1).float()
    hits = data.force_history.square().sum(dim=-1) > force_threshold**2
    return hits.any(dim=1).sum(dim=1).float()


class posture:
    """`exp(-mean_j ((q_j - q0_j) / std_j)^2)` over the selected joints, q0 the default positions.

    Params:
        std: Dict of joint name pattern, matched in full, to standard deviation (rad or m). Read
            once; must cover every selected joint.
        asset_cfg: Entity and joints; all joints without `joint_names`.
    """

    # Derived from the config; not checkpointed.
    _transient = {"std"}

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        asset_cfg: SceneEntityCfg = cfg.params["asset_cfg"]
        values = values_of_joints(env, asset_cfg, "std", cfg.params["std"])
        self.std = torch.tensor(values, dtype=torch.float, device=env.device)

    def __call__(
        self, env: ManagerBasedRlEnv, std: object, asset_cfg: SceneEntityCfg
    ) -> torch.Tensor:
        asset: Entity = env.scene[asset_cfg.name]
        joints = columns_of(asset_cfg, "joint", env)
        error = asset.data.joint_pos[:, joints] - asset.data.default_joint_pos[:, joints]
        return torch.exp(-(error / self.std).square().mean(dim=1))


def values_of_joints(
    env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg, name: str, table: dict[str, float]
) -> list[float]:
    """Return the value of each selected joint from `table`, a dict of joint name pattern to value.

    Raises:
        ValueError: a joint matches no pattern or several, or a pattern matches no joint. The message
            starts with `name`.
    """
    # `joint_names` and `joint_ids` have the same order, whatever `preserve_order`.
    joints = asset_cfg.joint_names
    joints = list(env.scene[asset_cfg.name].joint_names if joints is None else joints)
    try:
        _, covered, values = resolve_matching_names_values(table, joints)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    missing = [joint for joint in joints if joint not in covered]
    if missing:
        raise ValueError(
            f"{name}: expected patterns for all selected joints, got {list(table)}; missing: {missing}."
        )
    return [float(value) for value in values]


class electrical_power_cost:
    """Positive mechanical power of the actuators at the selected joints (W). Braking counts as 0."""

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRlEnv) -> None:
        pass

    def __call__(self, env: ManagerBasedRlEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
        asset: Entity = env.scene[asset_cfg.name]
        joints = columns_of(asset_cfg, "joint", env)
        power = asset.data.qfrc_actuator[:, joints] * asset.data.joint_vel[:, joints]
        return power.clamp_(min=0.0).sum(dim=1)


__getattr__ = older_names(__name__)
