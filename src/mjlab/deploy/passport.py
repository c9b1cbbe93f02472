"""Passport of a deployed policy: checks passed, warnings and stress curves, as one HTML page and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mjlab.deploy.check import Report
from mjlab.deploy.noise import unknown_noises
from mjlab.deploy.stress import UNITS, Point
from mjlab.utils.page import CHART_STYLE, Line, chart, facts, listed
from mjlab.utils.string import escaped

_STYLE = f"""{CHART_STYLE}
body{{font:15px sans-serif;max-width:1000px;margin:2em auto;padding:0 1em}}
td,th{{padding:2px 10px 2px 0;text-align:left}}
figure{{display:inline-block;width:300px;margin:8px}}"""


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
    origin = {**contract["source"], **settings}
    compared = [one for one in report.comparisons if one.num_rows]
    equal = sum(one.is_equal for one in compared)
    result = "passed" if report.is_passed else "FAILED"
    parts = [
        f"<h1>{escaped(str(contract['source']['task']))}</h1>",
        facts({key: _shown(key, value) for key, value in origin.items()}),
        f"<h2>Check: {result}</h2><p>{equal} of {len(compared)} values are those of training.</p>",
        listed([str(finding) for finding in report.findings]),
        "<h2>For a robot</h2>",
        listed(report.warnings or ["No warnings."]),
        "<h2>Not decidable by the trace</h2>",
        listed(report.undecided or ["Nothing."]),
        "<h2>Success under stress</h2><p>Share of episodes without a fall; bars are 95 % intervals.</p>",
        listed(unknown_noises(contract)),
        *(_curve(name, points) for name, points in curves.items()),
        report.table().html(),
    ]
    head = "<!doctype html><meta charset=utf-8><meta name=viewport content=width=device-width>"
    page = f"{head}<title>Passport</title><style>{_STYLE}</style>"
    path.write_text(page + "\n".join(parts) + "\n", encoding="utf-8")


def _shown(key: str, value: Any) -> Any:
    """Return a fact; the profile may be none, other facts without a value were not recorded."""
    if value is not None:
        return value
    return "none" if key == "profile" else "not recorded"


def _curve(name: str, points: list[Point]) -> str:
    """Return the drawing of a curve, with intervals."""
    levels = [point.level for point in points]
    line = Line(
        "",
        levels,
        [100.0 * point.rate for point in points],
        [(100.0 * least, 100.0 * most) for least, most in (point.interval for point in points)],
        has_marks=True,
    )
    title = f"{name.replace('_', ' ')} ({UNITS[name]})".replace(" ()", "")
    return chart(f"{title}: %", [line], y_range=(0.0, 100.0), x_ticks=levels)
