"""Curves of the reward terms, drawn over the native window."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from mjlab.viewer.history import TermHistory


@dataclass
class PlotCfg:
    """Reward plots of the native viewer."""

    history: int = 300
    """Number of environment steps shown."""
    p_lo: float = 2.0
    """Percentile of the values at the lower end of the y-range."""
    p_hi: float = 98.0
    """Percentile of the values at the upper end of the y-range."""
    pad: float = 0.25
    """Padding of the y-range at both ends, as a fraction of its span."""
    min_span: float = 1e-6
    """Smallest span of the y-range that is padded."""
    init_yrange: tuple[float, float] = (-0.01, 0.01)
    """Y-range of a term without values, or with zeros only."""
    grid_size: tuple[int, int] = (3, 4)
    """Number of grid lines along x and y."""
    max_viewports: int = 12
    """Number of terms plotted; the rest is left out."""
    min_rows_per_col: int = 4
    """Smallest number of rows a column is divided into."""
    max_rows_per_col: int = 6
    """Number of plots in a column before the next one begins."""
    plot_strip_fraction: float = 1 / 3
    """Fraction of the window's width that all columns together take."""
    background_alpha: float = 0.5
    """Opacity of the plots' black background."""


def reward_figures(
    history: TermHistory, viewport: mujoco.MjrRect, cfg: PlotCfg
) -> list[tuple[mujoco.MjrRect, mujoco.MjvFigure]]:
    """Return one figure per term and its place, for the first `cfg.max_viewports` terms."""
    places = compute_viewports(len(history.names), viewport, cfg)
    return [
        (place, _figure(name, history.values(name), cfg))
        for place, name in zip(places, history.names, strict=False)
    ]


def compute_viewports(num_plots: int, rect: mujoco.MjrRect, cfg: PlotCfg) -> list[mujoco.MjrRect]:
    """Return the places of `num_plots` plots in `rect`: from the top, columns from the right."""
    count = min(num_plots, cfg.max_viewports)
    if count < 1:
        return []
    most_columns = math.ceil(cfg.max_viewports / cfg.max_rows_per_col)
    columns = math.ceil(count / cfg.max_rows_per_col)
    rows = max(math.ceil(count / columns), cfg.min_rows_per_col)
    rows = min(rows, cfg.max_rows_per_col)
    width = int(cfg.plot_strip_fraction * rect.width) // most_columns
    height = rect.height // rows
    right, top = rect.left + rect.width, rect.bottom + rect.height
    cells = (divmod(index, rows) for index in range(count))
    return [
        mujoco.MjrRect(right - (column + 1) * width, top - (row + 1) * height, width, height)
        for column, row in cells
    ]


def make_empty_figure(
    title: str,
    grid_size: tuple[int, int],
    yrange: tuple[float, float],
    history: int,
    alpha: float,
) -> mujoco.MjvFigure:
    """Return a figure whose line 0 has `history` points at x = 0, -1, ... and y = 0.

    Args:
        title: Title of the figure.
        grid_size: Number of grid lines along x and y.
        yrange: Lowest and highest y shown.
        history: Number of points, at most what MuJoCo has room for (1001).
        alpha: Opacity of the black background.
    """
    figure = mujoco.MjvFigure()
    mujoco.mjv_defaultFigure(figure)
    figure.title = title
    figure.gridsize[:] = grid_size
    figure.range[1][:] = yrange
    figure.figurergba[:] = (0.0, 0.0, 0.0, alpha)
    count = min(history, figure.linedata.shape[1] // 2)
    figure.linedata[0, 0 : 2 * count : 2] = -np.arange(count)
    return figure


def plot_scale(values: np.ndarray, cfg: PlotCfg) -> tuple[int, float, float]:
    """Return the exponent of ten to divide a curve by, and its y-range.

    The range spans the percentiles of `cfg`, padded. Curves whose magnitude is outside
    [0.01, 1000) are scaled by a power of ten.
    """
    finite = values[np.isfinite(values)]
    magnitude = float(np.abs(finite).max(initial=0.0))
    if magnitude == 0.0:
        return 0, *cfg.init_yrange
    exponent = 0 if 0.01 <= magnitude < 1000.0 else math.floor(math.log10(magnitude))
    low, high = np.percentile(finite / 10.0**exponent, [cfg.p_lo, cfg.p_hi])
    # A flat curve gets a range too, wide enough for the labels of its axis to differ.
    padding = cfg.pad * max(high - low, 0.4 * abs(high), 0.4 * abs(low), cfg.min_span)
    return exponent, float(low - padding), float(high + padding)


def _figure(name: str, values: np.ndarray, cfg: PlotCfg) -> mujoco.MjvFigure:
    exponent, low, high = plot_scale(values, cfg)
    title = name if exponent == 0 else f"{name} (1e{exponent})"
    figure = make_empty_figure(title, cfg.grid_size, (low, high), cfg.history, cfg.background_alpha)
    figure.flg_extend = 0
    figure.linewidth = 2.0
    figure.range[0][:] = (-cfg.history, 0)
    figure.linergb[0][:] = (0.3, 0.8, 1.0)
    # The points are x, y pairs in one row; values that are not finite leave a gap.
    latest = values[-(figure.linedata.shape[1] // 2) :]
    steps = np.arange(1 - len(latest), 1)
    shown = np.isfinite(latest)
    count = int(shown.sum())
    figure.linepnt[0] = count
    figure.linedata[0, 0 : 2 * count : 2] = steps[shown]
    figure.linedata[0, 1 : 2 * count : 2] = np.clip(latest[shown] / 10.0**exponent, low, high)
    return figure
