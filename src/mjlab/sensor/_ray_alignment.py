"""Rotating the rays of a frame into the world."""

from __future__ import annotations

from typing import Literal

import torch

RayAlignment = Literal["base", "yaw", "world"]
"""How rays turn with their frame: fully, about the vertical only, or not at all."""

# Below this horizontal length of the frame's x axis, its y axis says where the frame points.
_STEEP = 0.1


def heading(mat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine of the yaw (...,) of rotation matrices (..., 3, 3).

    The direction is that of the horizontal projection of the frame's x axis. Where the x axis is
    nearly vertical (projection shorter than 0.1), it is the projection (a, b) of the y axis turned
    back by a quarter: (b, -a).
    """
    x, y = mat[..., :2, 0], mat[..., :2, 1]
    length = x.norm(dim=-1)
    turned = torch.stack((y[..., 1], -y[..., 0]), dim=-1)
    axis = torch.where((length < _STEEP)[..., None], turned, x)
    cosine, sine = torch.nn.functional.normalize(axis, dim=-1).unbind(-1)
    return cosine, sine


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
    for axis, column in enumerate(out.unbind(-1)):
        # Written as a sum from the smallest part, the start, to the vectors.
        origin = 0.0 if start is None else start[..., axis, None]
        if alignment == "base":
            rows = mat[..., axis, :, None].unbind(-2)
            column.copy_(origin + rows[0] * x)
            column.addcmul_(rows[1], y).addcmul_(rows[2], z)
        elif alignment == "world" or axis == 2:
            column.copy_(origin + vectors[:, axis])
        else:
            cosine, sine = (part[..., None] for part in heading(mat))
            first, second = (cosine, -sine) if axis == 0 else (sine, cosine)
            column.copy_(origin + first * x)
            column.addcmul_(second, y)
