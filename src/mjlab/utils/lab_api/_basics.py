"""Scalars and vectors: ranges, angles, norms."""

from __future__ import annotations

import torch


def scale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [lower, upper] linearly to [-1, 1]."""
    return 2.0 * (x - 0.5 * (lower + upper)) / (upper - lower)


def unscale_transform(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Map [-1, 1] linearly to [lower, upper]."""
    return 0.5 * x * (upper - lower) + 0.5 * (lower + upper)


def saturate(x: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Limit `x` to [lower, upper], element by element."""
    return torch.maximum(torch.minimum(x, upper), lower)


def normalize(x: torch.Tensor, eps: float = 1e-9) -> torch.Tensor:
    """Return the vectors on the last axis at unit length; those shorter than `eps` stay short."""
    return x / torch.linalg.vector_norm(x, dim=-1, keepdim=True).clamp(min=eps)


def wrap_to_pi(angles: torch.Tensor) -> torch.Tensor:
    """Return the angles (rad) in [-pi, pi]: odd multiples of pi keep their sign."""
    turned = torch.remainder(angles + torch.pi, 2.0 * torch.pi)
    return torch.where((turned == 0) & (angles > 0), torch.pi, turned - torch.pi)


def copysign(mag: float, other: torch.Tensor) -> torch.Tensor:
    """Return numbers of size `mag` with the signs of `other`."""
    return torch.copysign(torch.full_like(other, abs(mag)), other)


def matrix_product(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the products (..., i, k) of small matrices (..., i, j) and (..., j, k).

    They are sums, because a GPU may round the operands of `@` to TF32: 8 mm at 10 m.
    """
    return (first.unsqueeze(-1) * second.unsqueeze(-3)).sum(dim=-2)


def skew_symmetric_matrix(vec: torch.Tensor) -> torch.Tensor:
    """Return S with S u = vec x u; (..., 3) gives (..., 3, 3)."""
    x, y, z = vec.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
