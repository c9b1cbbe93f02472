"""Random numbers, points and orientations, drawn on the device asked for."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from mjlab.utils.lab_api._basics import normalize
from mjlab.utils.lab_api._conversions import quat_from_euler_xyz
from mjlab.utils.torch import constant_tensor

Size = int | tuple[int, ...]


def sample_uniform(
    lower: torch.Tensor | float, upper: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Return numbers uniform in [lower, upper). The bounds may be tensors that broadcast."""
    return torch.rand(_shape(size), dtype=torch.float32, device=device) * (upper - lower) + lower


def sample_ranges(ranges: Iterable[tuple[float, float]], size: Size, device: str) -> torch.Tensor:
    """Return numbers (*size, n), those of column i uniform in the i-th of n ranges [low, high)."""
    low, high = (
        constant_tensor(tuple(map(float, side)), device) for side in zip(*ranges, strict=True)
    )
    return sample_uniform(low, high, (*_shape(size), len(low)), device)


def sample_log_uniform(
    lower: torch.Tensor | float, upper: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Return numbers whose logarithm is uniform between those of the (positive) bounds."""
    low = torch.as_tensor(lower, dtype=torch.float32, device=device).log()
    high = torch.as_tensor(upper, dtype=torch.float32, device=device).log()
    return torch.exp(sample_uniform(low, high, size, device))


def sample_gaussian(
    mean: torch.Tensor | float, std: torch.Tensor | float, size: Size, device: str
) -> torch.Tensor:
    """Return normally distributed numbers.

    Where `mean` is a tensor, its shape is that of the result and `size` is not used.
    """
    shape = mean.shape if isinstance(mean, torch.Tensor) else _shape(size)
    return torch.randn(shape, dtype=torch.float32, device=device) * std + mean


def sample_triangle(lower: float, upper: float, size: Size, device: str) -> torch.Tensor:
    """Return numbers of the triangular distribution on [lower, upper], densest in the middle."""
    # The mean of two uniform numbers has this distribution.
    mean = 0.5 * (
        torch.rand(_shape(size), dtype=torch.float32, device=device)
        + torch.rand(_shape(size), dtype=torch.float32, device=device)
    )
    return mean * (upper - lower) + lower


def sample_cylinder(
    radius: float, h_range: tuple[float, float], size: Size, device: str
) -> torch.Tensor:
    """Return points (*size, 3) uniform on the side of a cylinder about z; z in `h_range`."""
    angle = sample_uniform(-torch.pi, torch.pi, size, device)
    height = sample_uniform(h_range[0], h_range[1], size, device)
    return torch.stack((radius * torch.cos(angle), radius * torch.sin(angle), height), dim=-1)


def default_orientation(num: int, device: str) -> torch.Tensor:
    """Return identity quaternions (num, 4)."""
    quat = torch.zeros(num, 4, dtype=torch.float32, device=device)
    quat[:, 0] = 1.0
    return quat


def random_orientation(num: int, device: str) -> torch.Tensor:
    """Return quaternions (num, 4) uniform over all orientations."""
    # The direction of a normally distributed vector is uniform on the sphere.
    return normalize(torch.randn(num, 4, dtype=torch.float32, device=device))


def random_yaw_orientation(num: int, device: str) -> torch.Tensor:
    """Return quaternions (num, 4) of rotations about z, uniform in angle."""
    zero = torch.zeros(num, dtype=torch.float32, device=device)
    return quat_from_euler_xyz(zero, zero, sample_uniform(0.0, 2.0 * torch.pi, num, device))


def _shape(size: Size) -> tuple[int, ...]:
    return (size,) if isinstance(size, int) else tuple(size)
