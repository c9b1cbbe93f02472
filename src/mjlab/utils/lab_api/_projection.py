"""Pinhole cameras: pixels and depths to points in the camera's frame, and back.

The camera looks along +z with x to the right and y down. With the intrinsic matrix K, pixel (u, v)
at depth z is the point z K^-1 (u, v, 1). Pixels are counted from the upper left, u along a row.
"""

from __future__ import annotations

import torch


def project_points(points: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return pixel coordinates and depth (u, v, z) of points.

    Args:
        points: Points in the camera's frame, (P, 3) or (N, P, 3).
        intrinsics: K, (3, 3) or (N, 3, 3).

    Returns:
        (N, P, 3), with N = 1 where neither has a batch dimension.

    Raises:
        ValueError: `points` has another number of dimensions.
    """
    if points.ndim not in (2, 3):
        raise ValueError(f"points: expected (P, 3) or (N, P, 3), got {tuple(points.shape)}.")
    # No matrix product, which a GPU may compute in TF32.
    scaled = (intrinsics.unsqueeze(-3) * points.unsqueeze(-2)).sum(-1)
    scaled = scaled if scaled.ndim == 3 else scaled.unsqueeze(0)
    return torch.cat((scaled[..., :2] / scaled[..., 2:], scaled[..., 2:]), dim=-1)


def unproject_depth(
    depth: torch.Tensor, intrinsics: torch.Tensor, is_ortho: bool = True
) -> torch.Tensor:
    """Return the points of a depth image in the camera's frame, column by column of the image.

    Args:
        depth: (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).
        intrinsics: K, (3, 3) or (N, 3, 3).
        is_ortho: True for depths along the camera's z axis, False for distances from the camera.

    Returns:
        (W H, 3), or (N, W H, 3) where the image or K has a batch dimension; point u H + v is that of
        pixel (u, v).

    Raises:
        ValueError: `depth` has another number of dimensions.
    """
    if not is_ortho:
        depth = orthogonalize_perspective_depth(depth, intrinsics)
    image = _without_channel(depth)
    rays = _rays(image, intrinsics)
    return (image.unsqueeze(-1) * rays).transpose(-3, -2).flatten(-3, -2)


def orthogonalize_perspective_depth(depth: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return depths along the camera's z axis from distances to the camera.

    Args:
        depth: (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1).
        intrinsics: K, (3, 3) or (N, 3, 3).

    Returns:
        The shape of `depth`, with N in front where only K has a batch dimension.

    Raises:
        ValueError: `depth` has another number of dimensions.
    """
    image = _without_channel(depth)
    result = image / torch.linalg.vector_norm(_rays(image, intrinsics), dim=-1)
    return result if image is depth else result.unsqueeze(-1)


def _without_channel(depth: torch.Tensor) -> torch.Tensor:
    if depth.ndim not in (2, 3, 4) or (depth.ndim == 4 and depth.shape[-1] != 1):
        raise ValueError(
            "depth: expected (H, W), (H, W, 1), (N, H, W) or (N, H, W, 1), "
            f"got {tuple(depth.shape)}."
        )
    has_channel = depth.ndim == 4 or (depth.ndim == 3 and depth.shape[-1] == 1)
    return depth.squeeze(-1) if has_channel else depth


def _rays(image: torch.Tensor, intrinsics: torch.Tensor) -> torch.Tensor:
    """Return K^-1 (u, v, 1) of all pixels, (H, W, 3) or (N, H, W, 3)."""
    height, width = image.shape[-2:]
    v, u = torch.meshgrid(
        torch.arange(height, device=image.device, dtype=image.dtype),
        torch.arange(width, device=image.device, dtype=image.dtype),
        indexing="ij",
    )
    k = intrinsics[..., None, None]  # (..., 3, 3, 1, 1)
    y = (v - k[..., 1, 2, :, :]) / k[..., 1, 1, :, :]
    x = (u - k[..., 0, 2, :, :] - k[..., 0, 1, :, :] * y) / k[..., 0, 0, :, :]
    return torch.stack((x, y, torch.ones_like(x)), dim=-1)
