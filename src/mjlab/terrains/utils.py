"""Helpers of sub-terrains: boxes, borders, flat patches, resampling."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

# MuJoCo rejects geoms of size 0.
_MIN_HALF_SIZE = 1e-6


@dataclass
class FlatPatchSamplingCfg:
    """Configuration of flat patch sampling on a height field."""

    num_patches: int = 10
    """Number of patches."""
    patch_radius: float = 0.5
    """Radius of a patch (m)."""
    max_height_diff: float = 0.05
    """Maximum height difference within a patch (m)."""
    x_range: tuple[float, float] = (-1e6, 1e6)
    """Range of patch centers along x, from the corner of the sub-terrain (m)."""
    y_range: tuple[float, float] = (-1e6, 1e6)
    """Range of patch centers along y, from the corner of the sub-terrain (m)."""
    z_range: tuple[float, float] = (-1e6, 1e6)
    """Range of patch center heights in the world frame (m)."""
    grid_resolution: float | None = None
    """Distance between candidate points (m), if finer than the field. None: field vertices."""


def make_plane(
    body: mujoco.MjsBody,
    size: tuple[float, float],
    height: float,
    center_zero: bool = True,
    plane_thickness: float = 1.0,
) -> list[mujoco.MjsGeom]:
    """Add one box with a flat top to `body` and return it in a list.

    Args:
        body: Parent body of the box.
        size: Extent along x and y (m).
        height: Height of the top (m).
        center_zero: Center the box on the body's origin. Otherwise the box starts at the origin
            and extends along +x and +y.
        plane_thickness: Extent of the box below its top (m).
    """
    x, y = (0.0, 0.0) if center_zero else (size[0] / 2, size[1] / 2)
    return [
        add_box(body, (x, y, height - plane_thickness / 2), (size[0], size[1], plane_thickness))
    ]


def make_border(
    body: mujoco.MjsBody,
    size: tuple[float, float],
    inner_size: tuple[float, float],
    height: float,
    position: tuple[float, float, float],
) -> list[mujoco.MjsGeom]:
    """Add a rectangular border of four boxes to `body` and return them: +y, -y, -x, +x.

    The ±y boxes span the full length along x; the ±x boxes lie between them.

    Args:
        body: Parent body of the boxes.
        size: Outer extent of the border along x and y (m).
        inner_size: Inner extent of the border along x and y (m).
        height: Extent of the boxes along z (m).
        position: Center of the border (m).
    """
    x, y, z = position
    thick_x, thick_y = (size[0] - inner_size[0]) / 2, (size[1] - inner_size[1]) / 2
    off_x, off_y = (inner_size[0] + thick_x) / 2, (inner_size[1] + thick_y) / 2
    along_x = (size[0], thick_y, height)
    along_y = (thick_x, inner_size[1], height)
    return [
        add_box(body, (x, y + off_y, z), along_x),
        add_box(body, (x, y - off_y, z), along_x),
        add_box(body, (x - off_x, y, z), along_y),
        add_box(body, (x + off_x, y, z), along_y),
    ]


def add_box(
    body: mujoco.MjsBody,
    center: tuple[float, float, float],
    extent: tuple[float, float, float],
) -> mujoco.MjsGeom:
    """Add a box with this center and full extent along x, y and z (m) to `body`."""
    half = [max(length / 2, _MIN_HALF_SIZE) for length in extent]
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, size=half)


def find_flat_patches_from_heightfield(
    heights: np.ndarray,
    horizontal_scale: float,
    z_offset: float,
    cfg: FlatPatchSamplingCfg,
    rng: np.random.Generator,
    size: tuple[float, float] | None = None,
) -> np.ndarray:
    """Sample flat patches of a height field, uniformly among all qualifying vertices.

    With `r = ceil(patch_radius / spacing)`, a vertex qualifies if heights over the disc
    `i^2 + j^2 <= r^2` of vertices around it differ by at most `max_height_diff`, if the disc is on
    the field, and if its position lies in the ranges of the config. With radius 0 the disc is the
    vertex. Vertices are sampled without replacement if possible. If no vertex qualifies, all
    patches are the field's center.

    Args:
        heights: (rows, cols) heights (m), [row, col]; rows run along y.
        horizontal_scale: Pixel size (m).
        z_offset: Offset from heights to world z (m).
        cfg: Number of patches, and criteria for a flat patch.
        rng: Source of all random numbers.
        size: Extent of the field along x and y (m). None: number of pixels times pixel size. The
            distance of vertices is `size / (n - 1)`, more than a pixel.

    Returns:
        (num_patches, 3) positions (m): x and y from the field's low corner, world z.
    """
    rows, cols = heights.shape
    if size is None:
        size = (cols * horizontal_scale, rows * horizontal_scale)
    center = (size[0] / 2, size[1] / 2, heights[rows // 2, cols // 2] + z_offset)
    if cfg.grid_resolution is not None and cfg.grid_resolution < horizontal_scale:
        finer = horizontal_scale / cfg.grid_resolution
        heights = resample_linear(heights, (round(rows * finer), round(cols * finer)))
    y, x = (
        np.linspace(0.0, extent, count)
        for extent, count in zip(size[::-1], heights.shape, strict=True)
    )
    # Radius of a patch in vertices along y and along x.
    r, c = (math.ceil(cfg.patch_radius / (axis[1] - axis[0]) - 1e-9) for axis in (y, x))
    spread = _disc_max(heights, r, c) + _disc_max(-heights, r, c)
    # Differences of multiples of a vertical step have rounding errors in the last bits.
    flat = spread <= cfg.max_height_diff + 1e-9
    z = heights + z_offset
    valid = (
        flat & _within(y, cfg.y_range)[:, None] & _within(x, cfg.x_range) & _within(z, cfg.z_range)
    )
    row, col = np.nonzero(valid)
    if len(row) == 0:
        return np.tile(center, (cfg.num_patches, 1))
    drawn = rng.choice(len(row), size=cfg.num_patches, replace=len(row) < cfg.num_patches)
    row, col = row[drawn], col[drawn]
    return np.stack((x[col], y[row], z[row, col]), axis=-1)


def interpolate_cubic(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Resample (rows, cols) values to another shape by bicubic splines, rounded to integers.

    Corners are preserved. Axes with fewer than four values use a spline of lower degree.
    """
    if values.shape == shape:
        return values
    # Importing SciPy takes a second, and few terrains need it.
    from scipy.interpolate import RectBivariateSpline

    old_y, old_x = (np.linspace(0.0, 1.0, count) for count in values.shape)
    degree_y, degree_x = (min(3, count - 1) for count in values.shape)
    spline = RectBivariateSpline(old_y, old_x, values, kx=degree_y, ky=degree_x)
    new_y, new_x = (np.linspace(0.0, 1.0, count) for count in shape)
    return np.rint(spline(new_y, new_x)).astype(int)


def resample_linear(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Resample (rows, cols) values to another shape by linear interpolation, with equal corners."""
    for axis, count in enumerate(shape):
        old = values.shape[axis]
        position = np.linspace(0.0, old - 1.0, count)
        low = np.minimum(position.astype(int), max(old - 2, 0))
        weight = np.expand_dims(position - low, 1 - axis)
        lower = np.take(values, low, axis)
        upper = np.take(values, np.minimum(low + 1, old - 1), axis)
        values = lower + weight * (upper - lower)
    return values


def lerp(ends: tuple[float, float], difficulty: float) -> float:
    """Interpolate linearly between the ends of a range: first at difficulty 0, second at 1."""
    return ends[0] + difficulty * (ends[1] - ends[0])


def _disc_max(values: np.ndarray, r: int, c: int) -> np.ndarray:
    """Return the maximum over the disc around each vertex; NaN if the disc leaves the field.

    A disc is a stack of rows, and the maximum of any run of columns is the maximum of two covering
    runs of power-of-two length. So the cost is linear, not quadratic, in the radius.

    Args:
        values: (rows, cols).
        r: Half-axis of the disc `(i / r)^2 + (j / c)^2 <= 1` along the rows, in vertices.
        c: Half-axis along the columns, in vertices.

    Returns:
        (rows, cols).
    """
    rows, cols = values.shape
    result = np.full(values.shape, np.nan)
    if rows <= 2 * r or cols <= 2 * c:
        return result
    runs = [values]
    while 2 ** len(runs) <= 2 * c + 1:
        shorter, step = runs[-1], 2 ** (len(runs) - 1)
        runs.append(np.maximum(shorter[:, : shorter.shape[1] - step], shorter[:, step:]))
    highest = result[r : rows - r, c : cols - c]
    highest[:] = -np.inf
    for i in range(-r, r + 1):
        half = int(c * math.sqrt(1.0 - (i / r) ** 2) + 1e-9) if r else c
        length = 2 * half + 1
        power = length.bit_length() - 1
        strip = runs[power][r + i : rows - r + i]
        for start in (c - half, c + half + 1 - 2**power):
            np.maximum(highest, strip[:, start : start + cols - 2 * c], out=highest)
    return result


def _within(values: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    return (values >= ends[0]) & (values <= ends[1])
