"""Parts of HTML pages: tables, lists, and charts as SVG, which need neither scripts nor a network."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mjlab.utils.string import escaped

COLORS = ("#1c7ed6", "#e8590c", "#2f9e44", "#9c36b5", "#0c8599", "#e03131")
"""Colors of lines, in order."""

_WIDTH, _HEIGHT = 400, 160
# Left, right, top and bottom of the axes.
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 390.0, 10.0, 122.0
_MOST_TICKS = 5
# Lines of more points look the same.
_MOST_POINTS = 400
_SPARK_WIDTH, _SPARK_HEIGHT = 120.0, 22.0


@dataclass(frozen=True)
class Line:
    """Line of a chart."""

    name: str
    """Name in the legend; empty for none."""
    x: Sequence[float]
    """Positions, (P,)."""
    y: Sequence[float]
    """Values, (P,). NaN: no point."""
    intervals: Sequence[tuple[float, float]] = ()
    """Interval around each value, (P, 2); empty for none."""
    has_marks: bool = False
    """Mark the points."""
    is_dashed: bool = False
    """Dash the line."""


def facts(rows: Mapping[str, Any]) -> str:
    """Return a table of names and values."""
    cells = (
        f"<tr><th>{escaped(name)}</th><td>{escaped(value)}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table>{''.join(cells)}</table>"


def listed(texts: Iterable[str]) -> str:
    """Return a list of texts."""
    return f"<ul>{''.join(f'<li>{escaped(text)}</li>' for text in texts)}</ul>"


def chart(
    title: str,
    lines: Sequence[Line],
    *,
    x_label: str = "",
    y_range: tuple[float, float] | None = None,
    x_ticks: Sequence[float] | None = None,
    rules: Sequence[float] = (),
    has_cursor: bool = False,
) -> str:
    """Return a figure of lines over a common axis.

    Args:
        title: Title.
        lines: Lines, with at least one finite value.
        x_label: Label of the x axis.
        y_range: Range of the y axis. None: that of the values.
        x_ticks: Labeled positions. None: round numbers.
        rules: Positions of vertical lines.
        has_cursor: Add a vertical line, whose position the page sets: `--share` of the axis, in [0, 1].
    """
    x = _Axis.over([v for line in lines for v in line.x], _LEFT, _RIGHT)
    values = [v for line in lines for pair in line.intervals for v in pair]
    values += [v for line in lines for v in line.y]
    y = _Axis.over(values if y_range is None else y_range, _BOTTOM, _TOP, pads=y_range is None)
    parts = [
        f'<path class="grid" d="M{_LEFT:g} {y(t):.1f}H{_RIGHT:g}"/>'
        f'<text x="{_LEFT - 6:g}" y="{y(t) + 4:.1f}" text-anchor="end">{t:g}</text>'
        for t in ticks(y.low, y.high)
    ]
    parts += [
        f'<text x="{x(t):.1f}" y="{_BOTTOM + 16:g}" text-anchor="middle">{t:g}</text>'
        for t in (ticks(x.low, x.high) if x_ticks is None else x_ticks)
    ]
    parts += [f'<path class="rule" d="M{x(r):.1f} {_TOP:g}V{_BOTTOM:g}"/>' for r in rules]
    if x_label:
        parts.append(
            f'<text x="{_RIGHT:g}" y="{_HEIGHT - 6}" text-anchor="end">{escaped(x_label)}</text>'
        )
    for line, color in zip(lines, _colors(lines), strict=True):
        parts += _drawn(line, color, x, y)
    if has_cursor:
        parts.append(_cursor(_LEFT, _RIGHT, _TOP, _BOTTOM))
    legend = "".join(
        f'<span style="color:{color}">{"┅" if line.is_dashed else "—"} {escaped(line.name)}</span> '
        for line, color in zip(lines, _colors(lines), strict=True)
        if line.name
    )
    return (
        f'<figure><figcaption>{escaped(title)}</figcaption><svg viewBox="0 0 {_WIDTH} {_HEIGHT}">'
        f"{''.join(parts)}</svg>{f'<div>{legend}</div>' if legend else ''}</figure>"
    )


def sparkline(x: Sequence[float], y: Sequence[float], color: str = COLORS[0]) -> str:
    """Return a small drawing of values (P,) without axes, with a cursor as in `chart`."""
    across = _Axis.over(x, 0.0, _SPARK_WIDTH)
    up = _Axis.over([0.0, *y], _SPARK_HEIGHT - 2.0, 2.0)
    zero = f'<path class="grid" d="M0 {up(0.0):.1f}H{_SPARK_WIDTH:g}"/>'
    return (
        f'<svg class="spark" viewBox="0 0 {_SPARK_WIDTH:g} {_SPARK_HEIGHT:g}">{zero}'
        f"{''.join(_drawn(Line('', x, y), color, across, up))}"
        f"{_cursor(0.0, _SPARK_WIDTH, 0.0, _SPARK_HEIGHT)}</svg>"
    )


def ticks(low: float, high: float) -> list[float]:
    """Return at most a few round numbers in [`low`, `high`]: multiples of 1, 2 or 5 times a power of 10."""
    least = (high - low) / _MOST_TICKS
    power = 10.0 ** math.floor(math.log10(least))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= least * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    # Rounded, so that 3 * 0.1 is 0.3.
    return [float(f"{i * step:.12g}") for i in range(first, last + 1)]


@dataclass(frozen=True)
class _Axis:
    """Map from values in [`low`, `high`] to positions in the drawing."""

    low: float
    high: float
    start: float
    end: float

    @classmethod
    def over(
        cls, values: Iterable[float], start: float, end: float, *, pads: bool = False
    ) -> _Axis:
        """Return the axis of finite `values`; `pads` leaves room around them."""
        finite = [float(value) for value in values if math.isfinite(value)]
        low, high = min(finite), max(finite)
        if low == high:
            half = 0.5 * abs(low) or 0.5
            low, high = low - half, high + half
        pad = 0.05 * (high - low) if pads else 0.0
        return cls(low - pad, high + pad, start, end)

    def __call__(self, value: float) -> float:
        share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)


def _drawn(line: Line, color: str, x: _Axis, y: _Axis) -> list[str]:
    """Return intervals, line and marks."""
    parts = [
        f'<path d="M{x(at):.1f} {y(low):.1f}V{y(high):.1f}" stroke="{color}" stroke-width="2"/>'
        for at, (low, high) in zip(line.x, line.intervals, strict=False)
    ]
    stride = -(-len(line.x) // _MOST_POINTS)
    points = [*zip(line.x, line.y, strict=True)][::stride]
    path, is_down = "", False
    for at, value in points:
        if is_finite := math.isfinite(value):
            path += f"{'L' if is_down else 'M'}{x(at):.1f} {y(value):.1f}"
        is_down = is_finite
    dashes = ' stroke-dasharray="6 4"' if line.is_dashed else ""
    parts.append(f'<path d="{path}" stroke="{color}" stroke-width="1.5"{dashes}/>')
    if line.has_marks:
        parts += [
            f'<circle cx="{x(at):.1f}" cy="{y(value):.1f}" r="3.5" fill="{color}"/>'
            for at, value in points
            if math.isfinite(value)
        ]
    return parts


def _cursor(left: float, right: float, top: float, bottom: float) -> str:
    return (
        f'<path class="cursor" style="--width:{right - left:g}px" '
        f'd="M{left:g} {top:g}V{bottom:g}"/>'
    )


def _colors(lines: Sequence[Line]) -> list[str]:
    return [COLORS[i % len(COLORS)] for i in range(len(lines))]


CHART_STYLE = """figure{margin:0 0 1em}figcaption{font-weight:600}
svg{width:100%;height:auto;display:block}svg text{font-size:10px;fill:currentColor}
svg path{fill:none}.grid{stroke:#8884;stroke-width:1}.rule{stroke:#888a;stroke-dasharray:2 3}
.cursor{stroke:#e03131;stroke-width:1.5;transform:translateX(calc(var(--share,0)*var(--width)))}
.spark{width:96px;height:18px}"""
"""Style sheet of charts."""
