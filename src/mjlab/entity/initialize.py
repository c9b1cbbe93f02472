"""The tensors of an entity's data, made once its model is compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from mjlab.entity.data import EntityData

if TYPE_CHECKING:
    from mjlab.entity.entity import Entity
    from mjlab.entity.indexing import EntityIndexing


def make_data(
    entity: Entity,
    indexing: EntityIndexing,
    model: Any,
    data: Any,
    device: str,
) -> EntityData:
    """Return the data of `entity`, with defaults from its config and all targets zero."""
    num_envs = data.nworld
    num_joints = len(indexing.joints)

    def row(values: Any) -> torch.Tensor:
        """Return one row for each environment, each its own memory."""
        one = torch.as_tensor(values, dtype=torch.float32, device=device)
        return one.expand(num_envs, *one.shape).clone()

    def zeros(width: int) -> torch.Tensor:
        return torch.zeros(num_envs, width, dtype=torch.float32, device=device)

    articulation = entity.cfg.articulation
    factor = 1.0 if articulation is None else articulation.soft_joint_pos_limit_factor
    limits = _joint_limits(model, indexing)
    num_tendons = len(indexing.tendons) if entity.has_tendon_actuators else 0
    return EntityData(
        indexing=indexing,
        data=data,
        model=model,
        device=device,
        default_root_state=row(entity.initial_state.root_state),
        default_joint_pos=row(entity.initial_state.joint_pos),
        default_joint_vel=row(entity.initial_state.joint_vel),
        default_joint_pos_limits=limits,
        joint_pos_limits=limits.clone(),
        soft_joint_pos_limits=_shrunk(limits, factor),
        gravity_vec_w=row((0.0, 0.0, -1.0)),
        forward_vec_b=row((1.0, 0.0, 0.0)),
        is_fixed_base=entity.is_fixed_base,
        is_articulated=entity.is_articulated,
        is_actuated=entity.is_actuated,
        joint_pos_target=zeros(num_joints),
        joint_vel_target=zeros(num_joints),
        joint_effort_target=zeros(num_joints),
        tendon_len_target=zeros(num_tendons),
        tendon_vel_target=zeros(num_tendons),
        tendon_effort_target=zeros(num_tendons),
        site_effort_target=zeros(len(indexing.sites) if entity.has_site_actuators else 0),
        encoder_bias=zeros(num_joints),
    )


def _joint_limits(model: Any, indexing: EntityIndexing) -> torch.Tensor:
    """Return (N, nj, 2) limits, infinite where the compiled joint is not limited."""
    ids = indexing.joint_ids.long()
    # Read from the simulation, because variants of an entity may have limits of their own.
    limits = model.jnt_range[:, ids].clone().float()
    limited = model.jnt_limited[..., ids].bool()
    limits[..., 0].masked_fill_(~limited, -torch.inf)
    limits[..., 1].masked_fill_(~limited, torch.inf)
    return limits


def _shrunk(limits: torch.Tensor, factor: float) -> torch.Tensor:
    """Return limits scaled by `factor` about their middle; infinite ones stay so."""
    middle = limits.mean(dim=-1)
    half = 0.5 * factor * (limits[..., 1] - limits[..., 0])
    shrunk = torch.stack((middle - half, middle + half), dim=-1)
    return torch.where(torch.isinf(limits), limits, shrunk)
