"""Terrain normal under a robot, estimated from ray hits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "terrain_normal_from_sensors",
]

_EPS = float(torch.finfo(torch.float32).eps)
# Upper bound of l0 / l1 for points on a plane.
_MAX_THICKNESS = 0.1
# Lower bound of l1 / l2: points on a line do not define a plane.
_MIN_WIDTH = 1e-6


def terrain_normal_from_sensors(
    env: ManagerBasedRlEnv, sensor_names: tuple[str, ...], max_points: int = 32
) -> torch.Tensor:
    """Return the upward unit normal of the terrain that ray sensors hit, (N, 3).

    Args:
        env: The environment.
        sensor_names: Ray sensors; one plane is fitted to all hits.
        max_points: Maximum number of rays per sensor, evenly spaced over its rays.
    """
    points, valid = [], []
    for name in sensor_names:
        data = env.scene[name].data
        count, device = data.distances.shape[1], data.distances.device
        rays: slice | torch.Tensor = slice(None)
        if count > max_points:
            rays = torch.linspace(
                0, count - 1, max_points, dtype=torch.float32, device=device
            ).long()
        points.append(data.hit_pos_w[:, rays])
        valid.append(data.distances[:, rays] >= 0.0)
    if len(points) == 1:
        return fit_terrain_normal(points[0], valid[0])
    return fit_terrain_normal(torch.cat(points, dim=1), torch.cat(valid, dim=1))


def fit_terrain_normal(points: torch.Tensor, valid_mask: torch.Tensor) -> torch.Tensor:
    """Return the upward unit normals of least-squares planes through points, (N, 3).

    With the scatter matrix `C = sum (p - m)(p - m)^T` of the valid points p and their mean m, the normal
    is the eigenvector of the smallest of the eigenvalues `l0 <= l1 <= l2` of C. The normal is (0, 0, 1)
    for fewer than three valid points, points on a line (`l1 <= 1e-6 l2`), and points that do not lie in a
    plane (`l0 >= 0.1 l1`).

    Args:
        points: Points in the world frame, (N, P, 3).
        valid_mask: Mask of valid points, (N, P) bool.
    """
    valid = valid_mask.unsqueeze(-1)
    # float64, because points far from the origin differ little from their mean.
    kept = torch.where(valid, points, 0.0).double()
    count = valid.sum(dim=1)
    center = kept.sum(dim=1) / count.clamp(min=1)
    offsets = torch.where(valid, kept - center.unsqueeze(1), 0.0)
    scatter = offsets.transpose(1, 2) @ offsets
    eye = torch.eye(3, dtype=scatter.dtype, device=scatter.device)
    is_finite = torch.isfinite(scatter).all(dim=-1).all(dim=-1)
    scatter = torch.where(is_finite[:, None, None], scatter, eye)
    least, middle, largest = _eigenvalues(scatter)
    normal = _null_vector(scatter - least[:, None, None] * eye)
    is_plane = (
        (count.squeeze(-1) >= 3)
        & is_finite
        & (least < _MAX_THICKNESS * middle.clamp(min=_EPS))
        & (middle > _MIN_WIDTH * largest.clamp(min=_EPS))
    )
    normal = torch.where(normal[:, 2:] < 0.0, -normal, normal)
    return torch.where(is_plane.unsqueeze(-1), normal, eye[2]).to(points.dtype)


def _eigenvalues(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the eigenvalues of symmetric (N, 3, 3) matrices, each (N,), ascending.

    Trigonometric solution of the characteristic polynomial (O. K. Smith, Communications of the ACM
    4(4), 1961). A few element-wise operations replace the batched solver, which calls LAPACK once per
    matrix and synchronizes with the GPU.
    """
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    shifted = matrix - mean[:, None, None] * eye
    radius = (shifted.square().sum(dim=(-2, -1)) / 6.0).sqrt()
    safe = radius.clamp(min=torch.finfo(matrix.dtype).tiny ** 0.25)
    a, b, c = (shifted / safe[:, None, None]).unbind(dim=-2)
    half_det = (a * torch.linalg.cross(b, c)).sum(dim=-1) / 2.0
    # Rounding errors may leave the domain of acos.
    angle = torch.acos(half_det.clamp(-1.0, 1.0)) / 3.0
    largest = mean + 2.0 * radius * torch.cos(angle)
    least = mean + 2.0 * radius * torch.cos(angle + 2.0 * math.pi / 3.0)
    return least, 3.0 * mean - largest - least, largest


def _null_vector(matrix: torch.Tensor) -> torch.Tensor:
    """Return unit null vectors of symmetric matrices of rank 2, (N, 3).

    A null vector is orthogonal to all rows and therefore parallel to the cross product of any two rows;
    the longest of the three cross products is the most precise.
    """
    a, b, c = matrix.unbind(dim=-2)
    first = torch.stack((a, b, c), dim=1)
    second = torch.stack((b, c, a), dim=1)
    crosses = torch.linalg.cross(first, second)
    lengths = crosses.square().sum(dim=-1)
    best = lengths.argmax(dim=1)
    rows = torch.arange(len(best), device=best.device)
    chosen, length = crosses[rows, best], lengths[rows, best].sqrt()
    return chosen / length.clamp(min=torch.finfo(matrix.dtype).tiny).unsqueeze(-1)
