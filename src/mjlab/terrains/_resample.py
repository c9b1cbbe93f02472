"""Heights on a grid of another shape."""

from __future__ import annotations

import numpy as np


def interpolate_cubic(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return whole (rows, cols) numbers of another shape, by a bicubic spline through those given.

    Corners stay where they are. With fewer than four numbers along an axis, the spline is of a
    lower degree there.
    """
    if values.shape == shape:
        return values
    # Loading it takes a second, and few terrains need it.
    from scipy.interpolate import RectBivariateSpline

    old_y, old_x = (np.linspace(0.0, 1.0, count) for count in values.shape)
    degree_y, degree_x = (min(3, count - 1) for count in values.shape)
    spline = RectBivariateSpline(old_y, old_x, values, kx=degree_y, ky=degree_x)
    new_y, new_x = (np.linspace(0.0, 1.0, count) for count in shape)
    return np.rint(spline(new_y, new_x)).astype(int)


def resample_linear(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Resample (rows, cols) values linearly to another shape; corners stay where they are."""
    for axis, count in enumerate(shape):
        values = _resample_axis(values, count, axis)
    return values


def _resample_axis(values: np.ndarray, count: int, axis: int) -> np.ndarray:
    old = values.shape[axis]
    position = np.linspace(0.0, old - 1.0, count)
    low = np.minimum(position.astype(int), max(old - 2, 0))
    weight = np.expand_dims(position - low, 1 - axis)
    lower = np.take(values, low, axis)
    upper = np.take(values, np.minimum(low + 1, old - 1), axis)
    return lower + weight * (upper - lower)
