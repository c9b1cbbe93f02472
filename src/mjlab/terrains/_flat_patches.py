"""Where a height field is flat enough to put something down."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mjlab.terrains._resample import resample_linear

if TYPE_CHECKING:
    from mjlab.terrains.terrain_generator import FlatPatchSamplingCfg


def find_flat_patches_from_heightfield(
    heights: np.ndarray,
    horizontal_scale: float,
    z_offset: float,
    cfg: FlatPatchSamplingCfg,
    rng: np.random.Generator,
    size: tuple[float, float] | None = None,
) -> np.ndarray:
    """Draw flat patches of a height field, uniformly among all vertices that qualify.

    With `r = ceil(patch_radius / spacing)`, a vertex qualifies if heights over the disc
    `i^2 + j^2 <= r^2` of vertices around it differ by at most `max_height_diff`, if the disc is on
    the field, and if its position lies in the ranges of the config. Radius 0 means the vertex
    alone. Vertices are drawn without replacement while there are enough. If none qualifies, all
    patches are the field's centre.

    Args:
        heights: (rows, cols) heights in metres, [row, col]: rows run along y.
        horizontal_scale: Size of a pixel in metres.
        z_offset: What to add to heights to get z of the world.
        cfg: How many to find, and what counts as flat.
        rng: Draws them.
        size: Extent of the field along x and y, in metres; None for pixels times their number. The
            vertices are `size / (n - 1)` apart, which is more than a pixel.

    Returns:
        (num_patches, 3) positions: x and y from the field's low corner, z of the world.
    """
    rows, cols = heights.shape
    if size is None:
        size = (cols * horizontal_scale, rows * horizontal_scale)
    centre = (size[0] / 2, size[1] / 2, heights[rows // 2, cols // 2] + z_offset)
    if cfg.grid_resolution is not None and cfg.grid_resolution < horizontal_scale:
        finer = horizontal_scale / cfg.grid_resolution
        heights = resample_linear(heights, (round(rows * finer), round(cols * finer)))
    y, x = (
        np.linspace(0.0, extent, count)
        for extent, count in zip(size[::-1], heights.shape, strict=True)
    )
    flat = _flat_vertices(heights, _disc_radii(cfg.patch_radius, y, x), cfg.max_height_diff)
    z = heights + z_offset
    valid = (
        flat & _within(y, cfg.y_range)[:, None] & _within(x, cfg.x_range) & _within(z, cfg.z_range)
    )
    row, col = np.nonzero(valid)
    if len(row) == 0:
        return np.tile(centre, (cfg.num_patches, 1))
    drawn = rng.choice(len(row), size=cfg.num_patches, replace=len(row) < cfg.num_patches)
    row, col = row[drawn], col[drawn]
    return np.stack((x[col], y[row], z[row, col]), axis=-1)


def check_flat_patch(name: str, cfg: FlatPatchSamplingCfg, size: tuple[float, float]) -> None:
    """Raise `ValueError` if no field of the size could ever have the patch.

    Args:
        name: What the patch is called, for the message.
        cfg: The patch.
        size: Extent of the field along x and y, in metres.
    """
    where = f"flat_patch_sampling[{name!r}]"
    if cfg.num_patches < 1:
        raise ValueError(f"{where}: num_patches is {cfg.num_patches}; it must be at least 1.")
    for field in ("patch_radius", "max_height_diff"):
        if not getattr(cfg, field) >= 0.0:
            raise ValueError(f"{where}: {field} is {getattr(cfg, field)}; it must not be negative.")
    if cfg.grid_resolution is not None and not cfg.grid_resolution > 0.0:
        raise ValueError(
            f"{where}: grid_resolution is {cfg.grid_resolution}; it must be above 0, or None."
        )
    if 2.0 * cfg.patch_radius > min(size):
        raise ValueError(
            f"{where}: a disc with patch_radius {cfg.patch_radius:g} does not fit on a sub-terrain "
            f"of {size[0]:g} x {size[1]:g} m. Use a radius of at most {min(size) / 2:g} m."
        )
    for field in ("x_range", "y_range", "z_range"):
        low, high = getattr(cfg, field)
        if not low <= high:
            raise ValueError(
                f"{where}: {field} is {(low, high)}; it must be (low, high) with low <= high."
            )
    for field, extent in (("x_range", size[0]), ("y_range", size[1])):
        low, high = getattr(cfg, field)
        first, last = cfg.patch_radius, extent - cfg.patch_radius
        if high < first or low > last:
            raise ValueError(
                f"{where}: {field} is {(low, high)}, but centres of patches lie from {first:g} to "
                f"{last:g} m. It is measured from the low corner of the sub-terrain."
            )


def _disc_radii(radius: float, y: np.ndarray, x: np.ndarray) -> tuple[int, int]:
    """Return the radius of a patch in vertices along y and along x."""
    along_y, along_x = (math.ceil(radius / (axis[1] - axis[0]) - 1e-9) for axis in (y, x))
    return along_y, along_x


def _within(values: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    return (values >= ends[0]) & (values <= ends[1])


def _flat_vertices(heights: np.ndarray, radii: tuple[int, int], limit: float) -> np.ndarray:
    """Return (rows, cols) whether heights over the disc around each vertex differ by `limit`."""
    flat = np.zeros(heights.shape, dtype=bool)
    r, c = radii
    rows, cols = heights.shape
    if rows > 2 * r and cols > 2 * c:
        spread = _disc_max(heights, radii) + _disc_max(-heights, radii)
        # Differences of multiples of a vertical step carry rounding of the last bits.
        flat[r : rows - r, c : cols - c] = spread <= limit + 1e-9
    return flat


def _disc_max(values: np.ndarray, radii: tuple[int, int]) -> np.ndarray:
    """Return the largest value over the disc around each vertex whose disc is on the field.

    A disc is a stack of rows, and the largest value of any run of columns is that of two runs of a
    power-of-two length that cover it. So the work grows with the radius rather than its square.

    Args:
        values: (rows, cols).
        radii: Half-axes (r, c) of the disc `(i / r)^2 + (j / c)^2 <= 1`, in vertices.

    Returns:
        (rows - 2 r, cols - 2 c).
    """
    r, c = radii
    rows, cols = values.shape
    runs = [values]
    while 2 ** len(runs) <= 2 * c + 1:
        shorter, step = runs[-1], 2 ** (len(runs) - 1)
        runs.append(np.maximum(shorter[:, : shorter.shape[1] - step], shorter[:, step:]))
    highest = np.full((rows - 2 * r, cols - 2 * c), -np.inf)
    for i in range(-r, r + 1):
        half = int(c * math.sqrt(1.0 - (i / r) ** 2) + 1e-9) if r else c
        length = 2 * half + 1
        power = length.bit_length() - 1
        strip = runs[power][r + i : rows - r + i]
        for start in (c - half, c + half + 1 - 2**power):
            np.maximum(highest, strip[:, start : start + cols - 2 * c], out=highest)
    return highest
