"""Randomization of joints and their degrees of freedom.

Quantities are also available under their MuJoCo names (`dof_damping`, `jnt_range`, `qpos0`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import torch

from mjlab.envs.mdp.dr._core import DOF, JOINT, QPOS, ROBOT, field_term, model_field, select
from mjlab.envs.mdp.dr._types import UNIFORM, draw, read_bounds
from mjlab.managers.event_manager import RecomputeLevel

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.envs.mdp.dr._core import Selection
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = [
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "encoder_bias",
    "jnt_range",
    "jnt_stiffness",
    "joint_armature",
    "joint_damping",
    "joint_default_pos",
    "joint_friction",
    "joint_limits",
    "joint_stiffness",
    "qpos0",
]

joint_armature = dof_armature = field_term(
    __name__,
    "joint_armature",
    DOF,
    "Randomize joint armature (kg m^2 of a hinge, kg of a slide).",
    field="dof_armature",
    recompute=RecomputeLevel.set_const_0,
)
joint_damping = dof_damping = field_term(
    __name__,
    "joint_damping",
    DOF,
    "Randomize joint damping (N m s/rad or N s/m).",
    field="dof_damping",
)
joint_friction = dof_frictionloss = field_term(
    __name__,
    "joint_friction",
    DOF,
    "Randomize dry joint friction (N m or N).",
    field="dof_frictionloss",
)
joint_stiffness = jnt_stiffness = field_term(
    __name__,
    "joint_stiffness",
    JOINT,
    "Randomize the stiffness of joint springs (N m/rad or N/m).",
    field="jnt_stiffness",
)


def refresh_entity_limits(selection: Selection) -> None:
    """Update the entity's hard and soft limits from the model's joint ranges.

    Joints without limits in the model keep infinite limits.
    """
    env, entity = selection.env, selection.entity
    limited = torch.as_tensor(env.sim.mj_model.jnt_limited, device=env.device).bool()
    chosen = limited[selection.columns]
    columns, joints = selection.columns[chosen], selection.local_ids[chosen]
    rows = selection.rows[:, None]
    limits = model_field(env, "jnt_range")[rows, columns[None, :]]
    articulation = entity.cfg.articulation
    factor = 1.0 if articulation is None else articulation.soft_joint_pos_limit_factor
    middle = limits.mean(dim=-1, keepdim=True)
    entity.data.joint_pos_limits[rows, joints[None, :]] = limits
    entity.data.soft_joint_pos_limits[rows, joints[None, :]] = middle + factor * (limits - middle)


joint_limits = jnt_range = field_term(
    __name__,
    "joint_limits",
    JOINT,
    "Randomize joint limits (rad or m) and the entity's hard and soft limits. Axis 0 is the "
    "lower limit, 1 the upper. One pair for both axes samples them independently, so use "
    "{0: ..., 1: ...} if the limits could cross.",
    field="jnt_range",
    after=refresh_entity_limits,
)


def normalize_ball_joints(selection: Selection) -> None:
    """Normalize the reference quaternions of selected ball joints."""
    env, model = selection.env, selection.env.sim.mj_model
    qpos0 = model_field(env, "qpos0")
    joints = selection.entity.data.indexing.joint_ids[selection.local_ids].tolist()
    for joint in joints:
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            address = int(model.jnt_qposadr[joint])
            index = selection.rows[:, None], torch.arange(address, address + 4, device=env.device)
            quat = qpos0[index]
            qpos0[index] = quat / quat.norm(dim=-1, keepdim=True)


joint_default_pos = qpos0 = field_term(
    __name__,
    "joint_default_pos",
    QPOS,
    "Shift the kinematic zero of joints (rad or m): the joint angle is qpos - qpos0. Default "
    "joint positions and reset targets of the entity are unchanged.",
    field="qpos0",
    operation="add",
    recompute=RecomputeLevel.set_const_0,
    after=normalize_ball_joints,
)


def encoder_bias(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    bias_range: tuple[float, float],
    asset_cfg: SceneEntityCfg = ROBOT,
) -> None:
    """Sample joint encoder biases (rad or m), uniform, per environment and joint.

    Measured positions are q + bias, and the bias is subtracted from position targets, so that
    measured and commanded positions agree. A bias replaces the previous one and persists across
    resets.

    Args:
        env_ids: Environments to change. None: all.
        bias_range: Lower and upper bound.
        asset_cfg: Entity and joints.
    """
    joints = select(env, env_ids, asset_cfg, JOINT)
    bounds = read_bounds(bias_range, "encoder_bias: bias_range")
    bias = draw(UNIFORM, bounds, joints.shape, env.device)
    joints.entity.data.encoder_bias[joints.rows[:, None], joints.local_ids[None, :]] = bias
