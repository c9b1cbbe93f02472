"""Randomization of bodies."""

from __future__ import annotations

import dataclasses
import warnings
from typing import TYPE_CHECKING, NamedTuple

import torch

from mjlab.envs.mdp.dr._core import (
    BODY,
    ROBOT,
    Selection,
    default_values,
    field_term,
    model_field,
    rotation_term,
    select,
)
from mjlab.envs.mdp.dr._types import Distribution, draw, read_bounds, resolve_distribution
from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields
from mjlab.utils.lab_api.math import matrix_from_quat, quat_from_matrix

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.managers.scene_entity_config import SceneEntityCfg

__all__ = [
    "body_com_offset",
    "body_ipos",
    "body_mass",
    "body_pos",
    "body_quat",
    "pseudo_inertia",
]


def warn_mass_without_inertia(selection: Selection) -> None:
    """Warn that a body whose mass changes keeps its inertia."""
    warnings.warn(
        "dr.body_mass changes mass but not inertia (physically inconsistent); use "
        "dr.pseudo_inertia with alpha_range to scale both.",
        UserWarning,
        stacklevel=4,
    )


body_mass = field_term(
    __name__,
    "body_mass",
    BODY,
    "Randomize body masses (kg). The inertia is unchanged; `pseudo_inertia` scales both.",
    operation="scale",
    recompute=RecomputeLevel.set_const,
    before=warn_mass_without_inertia,
)
body_com_offset = body_ipos = field_term(
    __name__,
    "body_com_offset",
    BODY,
    "Randomize centers of mass: offsets x, y, z (m) in the body frame.",
    field="body_ipos",
    operation="add",
    recompute=RecomputeLevel.set_const,
)
body_pos = field_term(
    __name__,
    "body_pos",
    BODY,
    "Randomize body positions x, y, z (m) in the parent frame.",
    operation="add",
    recompute=RecomputeLevel.set_const_0,
)
body_quat = rotation_term(
    __name__,
    "body_quat",
    BODY,
    "Perturb body orientations in the parent frame.",
    recompute=RecomputeLevel.set_const_0,
)

# Joint randomization of mass, center of mass and inertia.

_FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
_PARAMETERS = ("alpha", "d1", "d2", "d3", "s12", "s13", "s23", "t1", "t2", "t3")


class Inertial(NamedTuple):
    """Inertial parameters of bodies, with leading dimensions (...), as MuJoCo stores them."""

    mass: torch.Tensor
    """Mass (kg), (...)."""
    com: torch.Tensor
    """Center of mass (m) in the body frame, (..., 3)."""
    inertia: torch.Tensor
    """Principal moments of inertia (kg m^2), (..., 3)."""
    quat: torch.Tensor
    """Orientation of the principal axes in the body frame, (..., 4)."""


@requires_model_fields(*_FIELDS, recompute=RecomputeLevel.set_const)
def pseudo_inertia(
    env: ManagerBasedRlEnv,
    env_ids: torch.Tensor | None,
    alpha_range: tuple[float, float] = (0.0, 0.0),
    d_range: tuple[float, float] | None = None,
    d1_range: tuple[float, float] = (0.0, 0.0),
    d2_range: tuple[float, float] = (0.0, 0.0),
    d3_range: tuple[float, float] = (0.0, 0.0),
    s12_range: tuple[float, float] = (0.0, 0.0),
    s13_range: tuple[float, float] = (0.0, 0.0),
    s23_range: tuple[float, float] = (0.0, 0.0),
    t_range: tuple[float, float] | None = None,
    t1_range: tuple[float, float] = (0.0, 0.0),
    t2_range: tuple[float, float] = (0.0, 0.0),
    t3_range: tuple[float, float] = (0.0, 0.0),
    distribution: Distribution | str = "uniform",
    asset_cfg: SceneEntityCfg = ROBOT,
) -> None:
    """Randomize mass, center of mass and inertia with physical consistency.

    Every point of the default body moves by `x -> A x + t` in the body frame, and its density
    scales, so that mass is multiplied by `e^(2 alpha)`:

        A = [[e^d1, s12, s13], [0, e^d2, s23], [0, 0, e^d3]],   J' = e^(2 alpha) U J U^T,
        U = [[A, t], [0, 1]],   J = pseudo-inertia matrix (4 x 4) of the default body.

    Starts from the default, so repetitions do not accumulate. Principal moments are in ascending
    order. The ten parameters are sampled independently per environment and body, in the order
    alpha, d1..d3, s12, s13, s23, t1..t3.

    Args:
        env_ids: Environments to change. None: all.
        alpha_range: Half the logarithm of the mass factor.
        d1_range, d2_range, d3_range: Logarithms of the stretch along x, y, z.
        d_range: Replacement of the three ranges above.
        s12_range, s13_range, s23_range: Shears.
        t1_range, t2_range, t3_range: Shift of the center of mass (m) in the body frame.
        t_range: Replacement of the three ranges above.
        distribution: "uniform", "log_uniform", "gaussian", or a `Distribution`.
        asset_cfg: Entity and bodies.

    Selected bodies without mass or with an unphysical inertia keep their values, with a warning.

    Raises:
        ValueError: invalid range.
    """
    dist = resolve_distribution(distribution)
    d_ranges = (d1_range, d2_range, d3_range) if d_range is None else (d_range,) * 3
    t_ranges = (t1_range, t2_range, t3_range) if t_range is None else (t_range,) * 3
    ranges = (alpha_range, *d_ranges, s12_range, s13_range, s23_range, *t_ranges)
    bodies = _physical(select(env, env_ids, asset_cfg, BODY))
    default = pseudo_inertia_matrix(_defaults(bodies))
    parameters = []
    for name, value in zip(_PARAMETERS, ranges, strict=True):
        bounds = read_bounds(value, f"pseudo_inertia: {name}_range")
        parameters.append(draw(dist, bounds, bodies.shape, env.device).double())
    alpha, d1, d2, d3, s12, s13, s23, t1, t2, t3 = parameters
    zero, one = torch.zeros_like(alpha), torch.ones_like(alpha)
    rows = (
        (torch.exp(d1), s12, s13, t1),
        (zero, torch.exp(d2), s23, t2),
        (zero, zero, torch.exp(d3), t3),
        (zero, zero, zero, one),
    )
    u = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    transform = torch.exp(alpha)[..., None, None] * u
    perturbed = transform @ default @ transform.transpose(-1, -2)
    new = inertial_from_pseudo_inertia(perturbed)
    for field, value in zip(_FIELDS, new, strict=True):
        model_field(env, field)[bodies.index] = value.float()


def _defaults(bodies: Selection) -> Inertial:
    return Inertial(*(default_values(bodies, field).double() for field in _FIELDS))


def _physical(bodies: Selection) -> Selection:
    """Return the bodies with a positive definite pseudo-inertia matrix; warn if others are selected."""
    values = _defaults(bodies)
    # J is positive definite iff the mass and the second moments of mass along the principal axes
    # are positive. The margin covers float32 rounding: a flat body has a zero second moment.
    trace = values.inertia.sum(dim=-1, keepdim=True)
    second_moments = 0.5 * trace - values.inertia
    unphysical = (second_moments <= 2e-7 * trace).any(dim=-1) | (values.mass <= 0.0)
    bad = unphysical.any(dim=0)
    if not bad.any():
        return bodies
    invalid = [name for name, is_bad in zip(bodies.names, bad.tolist(), strict=True) if is_bad]
    warnings.warn(
        f"pseudo_inertia: bodies {invalid} have no mass or an unphysical inertia (pseudo-inertia "
        "matrix not positive definite) and keep it; exclude them from body_names, or set mass and "
        "inertia in the model.",
        UserWarning,
        stacklevel=3,
    )
    kept = {"local_ids": bodies.local_ids[~bad], "columns": bodies.columns[~bad]}
    return dataclasses.replace(bodies, **kept)


def pseudo_inertia_matrix(body: Inertial) -> torch.Tensor:
    """Return J = [[Sigma, m c], [m c^T, m]], (..., 4, 4).

    Sigma = tr(I_o) / 2 * 1 - I_o is the second moment of mass about the origin of the body frame,
    and I_o the inertia about that origin.
    """
    rotation = matrix_from_quat(body.quat)
    about_com = rotation @ torch.diag_embed(body.inertia) @ rotation.transpose(-1, -2)
    mass = body.mass[..., None, None]
    about_origin = about_com + mass * _steiner(body.com)
    sigma = 0.5 * _trace_identity(about_origin) - about_origin
    moment = body.mass[..., None] * body.com
    top = torch.cat((sigma, moment[..., None]), dim=-1)
    bottom = torch.cat((moment, body.mass[..., None]), dim=-1)
    return torch.cat((top, bottom[..., None, :]), dim=-2)


def inertial_from_pseudo_inertia(matrix: torch.Tensor) -> Inertial:
    """Return the inertial parameters of pseudo-inertia matrices, (..., 4, 4).

    Principal moments are ascending; the axes are right-handed.
    """
    mass = matrix[..., 3, 3]
    com = matrix[..., :3, 3] / mass[..., None]
    sigma = matrix[..., :3, :3]
    about_origin = _trace_identity(sigma) - sigma
    about_com = about_origin - mass[..., None, None] * _steiner(com)
    inertia, axes = torch.linalg.eigh(0.5 * (about_com + about_com.transpose(-1, -2)))
    sign = torch.where(torch.linalg.det(axes) < 0.0, -1.0, 1.0).to(axes.dtype)
    # The sign of eigenvectors is arbitrary: flip the third to get a rotation (determinant 1).
    axes = torch.cat((axes[..., :2], axes[..., 2:] * sign[..., None, None]), dim=-1)
    return Inertial(mass, com, inertia, quat_from_matrix(axes))


def _steiner(com: torch.Tensor) -> torch.Tensor:
    """Return |c|^2 1 - c c^T, the inertia of a unit mass at c about the origin."""
    outer = com[..., :, None] * com[..., None, :]
    return _trace_identity(outer) - outer


def _trace_identity(matrix: torch.Tensor) -> torch.Tensor:
    """Return tr(M) 1."""
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    return trace[..., None, None] * torch.eye(3, dtype=matrix.dtype, device=matrix.device)
