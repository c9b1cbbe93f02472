"""Passport of a deployed policy: checks passed, warnings and stress curves, as one HTML page and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjlab.deploy.check import Report
from mjlab.deploy.noise import unknown_noises
from mjlab.deploy.stress import UNITS, Point
from mjlab.utils.string import escaped

_WIDTH, _HEIGHT, _MARGIN = 300, 180, 44
_STYLE = """body{font:15px sans-serif;max-width:1000px;margin:2em auto;padding:0 1em}
td,th{padding:2px 10px 2px 0;text-align:left}figure{display:inline-block;margin:8px}"""


def as_dict(
    contract: Mapping[str, Any],
    report: Report,
    curves: Mapping[str, list[Point]],
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of a passport for JSON."""
    return {
        "source": contract["source"],
        "check": report.as_dict(),
        "stress": {
            "settings": dict(settings),
            "left_out": unknown_noises(contract),
            "curves": {
                name: [
                    {
                        "level": point.level,
                        "unit": UNITS[name],
                        "successes": point.successes,
                        "episodes": point.episodes,
                        "interval": list(point.interval),
                    }
                    for point in points
                ]
                for name, points in curves.items()
            },
        },
    }


def write_passport(
    path: Path,
    contract: Mapping[str, Any],
    report: Report,
    curves: Mapping[str, list[Point]],
    settings: Mapping[str, Any],
) -> None:
    """Write the page `path`, and JSON beside it."""
    content = as_dict(contract, report, curves, settings)
    path.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    facts = {**contract["source"], **settings}
    rows = [
        f"<tr><th>{escaped(key)}</th><td>{escaped(str(value))}</td></tr>"
        for key, value in facts.items()
    ]
    compared = [one for one in report.comparisons if one.num_rows]
    equal = sum(one.is_equal for one in compared)
    result = "passed" if report.is_passed else "FAILED"
    parts = [
        f"<h1>{escaped(str(contract['source']['task']))}</h1>",
        f"<table>{''.join(rows)}</table>",
        f"<h2>Check: {result}</h2><p>{equal} of {len(compared)} values are those of training.</p>",
        _listed([str(finding) for finding in report.findings]),
        "<h2>For a robot</h2>",
        _listed(report.warnings or ["No warnings."]),
        "<h2>Not decidable by the trace</h2>",
        _listed(report.undecided or ["Nothing."]),
        "<h2>Success under stress</h2><p>Share of episodes without a fall; bars are 95 % intervals.</p>",
        _listed(unknown_noises(contract)),
        *(_curve(name, points) for name, points in curves.items()),
        report.table().html(),
    ]
    page = f"<!doctype html><meta charset=utf-8><title>Passport</title><style>{_STYLE}</style>"
    path.write_text(page + "\n".join(parts) + "\n", encoding="utf-8")


def _listed(texts: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{escaped(text)}</li>' for text in texts)}</ul>"


def _curve(name: str, points: list[Point]) -> str:
    """Return the drawing of a curve, with intervals."""
    low, high = points[0].level, points[-1].level
    wide, tall = _WIDTH - 2 * _MARGIN, _HEIGHT - 2 * _MARGIN

    def x(level: float) -> float:
        return _MARGIN + wide * (level - low) / ((high - low) or 1.0)

    def y(rate: float) -> float:
        return _MARGIN + tall * (1.0 - rate)

    marks = [
        f'<line x1="{_MARGIN}" x2="{_WIDTH - _MARGIN}" y1="{y(r)}" y2="{y(r)}" stroke="#ddd"/>'
        f'<text x="4" y="{y(r) + 4}" font-size="11">{100 * r:.0f} %</text>'
        for r in (0.0, 0.5, 1.0)
    ]
    for point in points:
        least, most = point.interval
        at = x(point.level)
        marks.append(
            f'<line x1="{at}" x2="{at}" y1="{y(least)}" y2="{y(most)}" stroke="#48c" stroke-width="2"/>'
            f'<circle cx="{at}" cy="{y(point.rate)}" r="4" fill="#26a"/>'
            f'<text x="{at - 8}" y="{_HEIGHT - 16}" font-size="11">{point.level:g}</text>'
        )
    line = " ".join(f"{x(point.level)},{y(point.rate)}" for point in points)
    marks.append(f'<polyline points="{line}" fill="none" stroke="#26a"/>')
    title = escaped(f"{name.replace('_', ' ')} ({UNITS[name]})".replace(" ()", ""))
    return (
        f'<figure><figcaption>{title}</figcaption><svg width="{_WIDTH}" height="{_HEIGHT}">'
        f"{''.join(marks)}</svg></figure>"
    )
