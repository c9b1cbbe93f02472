"""Randomization of joints and their degrees of freedom."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mjlab.envs.mdp.dr._core import JOINT, ROBOT, field_term, select
from mjlab.envs.mdp.dr._types import draw, read_bounds, resolve_distribution

if TYPE_CHECKING:
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

joint_armature = field_term("joint_armature")
joint_damping = field_term("joint_damping")
joint_default_pos = field_term("joint_default_pos")
joint_friction = field_term("joint_friction")
joint_limits = field_term("joint_limits")
joint_stiffness = field_term("joint_stiffness")

# MuJoCo's own names of the fields.
dof_armature = joint_armature
dof_damping = joint_damping
dof_frictionloss = joint_friction
jnt_range = joint_limits
jnt_stiffness = joint_stiffness
qpos0 = joint_default_pos


def encoder_bias(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    bias_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = ROBOT,
) -> None:
    """Draw joint encoder biases (rad or m), uniform, per environment and joint.

    Sensed positions are q + bias, and position targets are lowered by the bias, so sensed and
    commanded frames agree. A bias replaces the previous one and survives resets.

    Args:
        env_ids: Environments to change; None means all.
        bias_range: Lower and upper bound.
        asset_cfg: Entity and joints.
    """
    joints = select(env, env_ids, asset_cfg, JOINT)
    bounds = read_bounds(bias_range, "encoder_bias: bias_range")
    bias = draw(resolve_distribution("uniform"), bounds, joints.shape, env.device)
    joints.entity.data.encoder_bias[joints.rows[:, None], joints.local_ids[None, :]] = bias
