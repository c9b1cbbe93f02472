"""The direction of the ground under a robot, from rays."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import torch

from mjlab.managers.term_checks import require_sensor
from mjlab.sensor import RayCastSensor
from mjlab.utils.errors import WrongTypeError

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

__all__ = [
    "terrain_normal_from_sensors",
]

_EPS = float(torch.finfo(torch.float32).eps)
# Points lie in a plane if their spread across it is below this share of the spread along it.
_MAX_THICKNESS = 0.1
# Points that lie on a line have no plane.
_MIN_WIDTH = 1e-6


def terrain_normal_from_sensors(
    env: ManagerBasedRlEnv, sensor_names: tuple[str, ...], max_points: int = 32
) -> torch.Tensor:
    """Return the upward normal of the ground that ray sensors see, (N, 3).

    Args:
        env: The environment.
        sensor_names: Ray sensors, whose hits are fitted together.
        max_points: Most rays to take of each sensor; they are spread evenly over its rays.

    Raises:
        TypeError: a sensor is no ray sensor.
    """
    points, valid = [], []
    for name in sensor_names:
        sensor = env.scene[name]
        if not isinstance(sensor, RayCastSensor):
            raise WrongTypeError(
                f"Sensor {name!r}: expected RayCastSensor, got {type(sensor).__name__}."
            )
        data = sensor.data
        rays = _spread(data.distances.shape[1], max_points, str(data.distances.device))
        points.append(data.hit_pos_w[:, rays])
        valid.append(data.distances[:, rays] >= 0.0)
    if len(points) == 1:
        return fit_terrain_normal(points[0], valid[0])
    return fit_terrain_normal(torch.cat(points, dim=1), torch.cat(valid, dim=1))


def check_terrain_sensors(env: ManagerBasedRlEnv, sensor_names: tuple[str, ...]) -> None:
    """Raise `ValueError` or `TypeError` unless these are ray sensors of the scene."""
    for name in sensor_names:
        require_sensor(env, name, RayCastSensor)


@functools.lru_cache(maxsize=64)
def _spread(count: int, max_points: int, device: str) -> torch.Tensor | slice:
    if count <= max_points:
        return slice(None)
    return torch.linspace(0, count - 1, max_points, dtype=torch.float32).long().to(device)


def fit_terrain_normal(points: torch.Tensor, valid_mask: torch.Tensor) -> torch.Tensor:
    """Return the upward unit normals of the planes through points, (N, 3).

    It is the direction of least spread: with `C = sum (p - m)(p - m)^T` over the valid points and
    their centre m, the eigenvector of the smallest of the eigenvalues `l0 <= l1 <= l2` of C.
    Where that says nothing the normal is (0, 0, 1): with fewer than three valid points, where they
    lie on a line (`l1 <= 1e-6 l2`), or where they are not flat (`l0 >= 0.1 l1`).

    Args:
        points: (N, P, 3) points, in world axes.
        valid_mask: (N, P) bool, which of them count.
    """
    valid = valid_mask.unsqueeze(-1)
    # In double precision, because points far from the origin differ by little from their centre.
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

    The trigonometric solution of the characteristic polynomial (O. K. Smith, Communications of the
    ACM 4(4), 1961). It takes a few element-wise operations, where a batched solver takes a call of
    LAPACK for every matrix, and on a GPU waits for the device.
    """
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    shifted = matrix - mean[:, None, None] * eye
    radius = (shifted.square().sum(dim=(-2, -1)) / 6.0).sqrt()
    safe = radius.clamp(min=torch.finfo(matrix.dtype).tiny ** 0.25)
    a, b, c = (shifted / safe[:, None, None]).unbind(dim=-2)
    half_det = (a * torch.linalg.cross(b, c)).sum(dim=-1) / 2.0
    # Rounding may leave the domain of the arc cosine.
    angle = torch.acos(half_det.clamp(-1.0, 1.0)) / 3.0
    largest = mean + 2.0 * radius * torch.cos(angle)
    least = mean + 2.0 * radius * torch.cos(angle + 2.0 * math.pi / 3.0)
    return least, 3.0 * mean - largest - least, largest


def _null_vector(matrix: torch.Tensor) -> torch.Tensor:
    """Return unit vectors (N, 3) that symmetric matrices of rank 2 send to zero.

    Such a vector is orthogonal to all rows, so a cross product of two rows; the longest one of the
    three is the most precise.
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
