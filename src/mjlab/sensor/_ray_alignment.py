"""Rotating the rays of a frame into the world."""

from __future__ import annotations

from typing import Literal

import torch

RayAlignment = Literal["base", "yaw", "world"]
"""How rays turn with their frame: fully, about the vertical only, or not at all."""

# Below this horizontal length of the frame's x axis, its y axis says where the frame points.
_STEEP = 0.1
_TINY = 1e-12


def heading(mat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine of the yaw (...,) of rotation matrices (..., 3, 3).

    The direction is that of the horizontal projection of the frame's x axis. Where the x axis is
    nearly vertical (projection shorter than 0.1), it is the projection (a, b) of the y axis turned
    back by a quarter: (b, -a).
    """
    # By components: an operation over a last dimension of two takes a CPU ten times as long.
    x, y = mat[..., 0, 0], mat[..., 1, 0]
    is_steep = x * x + y * y < _STEEP**2
    x = torch.where(is_steep, mat[..., 1, 1], x)
    y = torch.where(is_steep, -mat[..., 0, 1], y)
    length = (x * x + y * y).sqrt_().clamp_(min=_TINY)
    return x / length, y / length


def is_constant(vectors: torch.Tensor, alignment: RayAlignment) -> bool:
    """Return whether vectors (n, 3) of the aligned frame point the same way in every pose."""
    if alignment == "world":
        return True
    return alignment == "yaw" and bool((vectors[:, :2] == 0.0).all())


def rotate_into(
    out: torch.Tensor,
    vectors: torch.Tensor,
    mat: torch.Tensor,
    alignment: RayAlignment,
    start: torch.Tensor | None = None,
) -> None:
    """Write `start + A vectors` into `out`, with A the aligned orientation of each frame.

    Column by column, because every column is one operation over all environments and rays, and
    without a matrix product, which a GPU may round to TF32: centimetres, far from the origin.

    Args:
        out: (N, F, n, 3).
        vectors: (n, 3) in the aligned frame.
        mat: (N, F, 3, 3) orientations of the frames.
        alignment: Which part of the orientation counts.
        start: (N, F, 3) world positions; None for none.
    """
    x, y, z = vectors.unbind(-1)
    if alignment == "yaw":
        cosine, sine = (part[..., None] for part in heading(mat))
        turn = (cosine, -sine), (sine, cosine)
    else:
        turn = ()
    for axis, column in enumerate(out.unbind(-1)):
        if alignment == "base":
            first, second, third = mat[..., axis, :, None].unbind(-2)
            part = (first * x).addcmul_(second, y).addcmul_(third, z)
        elif alignment == "world" or axis == 2:
            part = vectors[:, axis].expand_as(column)
        else:
            first, second = turn[axis]
            part = (first * x).addcmul_(second, y)
        # The start comes last: far from the origin, sums with it are rounded most.
        torch.add(part, 0.0 if start is None else start[..., axis, None], out=column)
