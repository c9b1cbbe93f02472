"""Curves of the reward terms, drawn over the native window."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from mjlab.viewer.history import TermHistory

PLOT_POINTS = 300
_MAX_PLOTS = 12
_ROWS = 6
_WIDTH_FRACTION = 0.22


def reward_figures(
    history: TermHistory, viewport: mujoco.MjrRect
) -> list[tuple[mujoco.MjrRect, mujoco.MjvFigure]]:
    """One figure a term, stacked along the right edge; a second column beyond six terms."""
    names = history.names[:_MAX_PLOTS]
    width = int(_WIDTH_FRACTION * viewport.width)
    height = viewport.height // max(min(len(names), _ROWS), 3)
    figures = []
    for index, name in enumerate(names):
        column, row = divmod(index, _ROWS)
        rect = mujoco.MjrRect(
            viewport.left + viewport.width - (column + 1) * width,
            viewport.bottom + viewport.height - (row + 1) * height,
            width,
            height,
        )
        figures.append((rect, _figure(name, history.values(name))))
    return figures


def plot_scale(values: np.ndarray) -> tuple[int, float, float]:
    """Exponent to divide by and the y-range for a curve.

    The range spans the 2nd to the 98th percentile, padded by a quarter. Curves whose magnitude is
    outside [0.01, 1000) are scaled by a power of ten.
    """
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0, -1.0, 1.0
    magnitude = float(np.abs(finite).max())
    exponent = 0
    if magnitude > 0 and not 0.01 <= magnitude < 1000.0:
        exponent = math.floor(math.log10(magnitude))
    low, high = np.percentile(finite / 10.0**exponent, [2, 98])
    # A flat curve gets a range too, wide enough for the labels of its axis to differ.
    padding = 0.25 * max(high - low, 0.4 * abs(high), 0.4 * abs(low), 1e-3)
    return exponent, float(low - padding), float(high + padding)


def _figure(name: str, values: np.ndarray) -> mujoco.MjvFigure:
    exponent, low, high = plot_scale(values)
    figure = mujoco.MjvFigure()
    mujoco.mjv_defaultFigure(figure)
    figure.title = name if exponent == 0 else f"{name} (1e{exponent})"
    figure.flg_extend = 0
    figure.gridsize[:] = (2, 3)
    figure.figurergba[:] = (0.0, 0.0, 0.0, 0.5)
    figure.linewidth = 2.0
    figure.range[0][:] = (-PLOT_POINTS, 0)
    figure.range[1][:] = (low, high)
    figure.linergb[0][:] = (0.3, 0.8, 1.0)
    # The points are x, y pairs in one row; what is not finite leaves a gap.
    steps = np.arange(1 - len(values), 1)
    shown = np.isfinite(values)
    count = int(shown.sum())
    figure.linepnt[0] = count
    figure.linedata[0, 0 : 2 * count : 2] = steps[shown]
    figure.linedata[0, 1 : 2 * count : 2] = np.clip(values[shown] / 10.0**exponent, low, high)
    return figure
