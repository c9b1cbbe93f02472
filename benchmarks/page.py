"""Write `docs/benchmarks.md` and its plots from `results/table.json`: `make bench` does so at its end."""

from __future__ import annotations

import json
import re
from pathlib import Path

from matplotlib.figure import Figure
from measure import RESULTS, Row, show

_DOCS = Path(__file__).parents[1] / "docs"
_PLOT = "images/benchmarks_speed.png"
_BLUE, _GRAY = "#3a6ea5", "#b8c0c8"

# Sections of the page: title, words in the row's name, introduction.
_SECTIONS = (
    (
        "Speed of a step",
        ("env.step", "env-steps/s", "memory that", "with `xpos` read"),
        "`env.step` is compared with a bare loop of `mujoco.batch` that steps the same models from the "
        "same states without rewards, observations or resets.",
    ),
    ("Cameras", ("cameras,",), "Images per second of the native engine."),
    (
        "Start-up",
        ("list-envs", "train --help", "train TASK", "first finished iteration"),
        "Seconds from the command to its result.",
    ),
    ("Repeatability", ("same seed", "SIGKILL"), "Weights are compared bit by bit."),
    (
        "Learning",
        ("swing-up", "to that point", "profile cpu", "train --live"),
        "Training from the command line until an evaluation on new episodes is solved.",
    ),
    ("Inverse kinematics", ("reach of",), "Targets 10 cm away, 1,024 YAM arms."),
)


def write_page() -> Path:
    """Write the page and return its path."""
    content = json.loads((RESULTS / "table.json").read_text(encoding="utf-8"))
    rows = [Row(**row) for row in content["rows"]]
    draw_speed(rows, _DOCS / _PLOT)
    machine = content["machine"]
    parts = [
        "# Benchmarks",
        f"Measured by `make bench` on {machine['cores']} cores ({machine['processor']}), "
        f"{machine['date']}, Python {machine['python']}, torch {machine['torch']}, MuJoCo "
        f"{machine['mujoco']}. This page is written by `make bench`. Machines are noisy, so a speed is "
        "reported as a ratio to a comparison measured alternately in the same minutes. Targets that "
        "were missed are listed as well.",
        f"![Environment steps per second, and as a share of a bare loop]({_PLOT})",
    ]
    # Comparisons with an earlier commit, by `make bench BEFORE=...`, are for developers.
    left = [row for row in rows if "other checkout" not in row.what]
    for title, words, introduction in _SECTIONS:
        chosen = [row for row in left if any(word in row.what for word in words)]
        left = [row for row in left if row not in chosen]
        if chosen:
            parts += [f"## {title}", introduction, show(chosen)]
    if left:
        parts += ["## Others", show(left)]
    parts += [
        "Learning curves and times of all stock tasks: [Reference runs](reference/runs/index.md)."
    ]
    page = _DOCS / "benchmarks.md"
    page.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return page


def draw_speed(rows: list[Row], path: Path) -> None:
    """Plot the steps per second of each task beside those of the bare loop."""
    found = []
    for row in rows:
        ours = re.search(r"\(([\d,]+) env-steps/s\)", row.measured)
        bare = re.search(r"bare `mujoco.batch` loop: ([\d,]+) env-steps/s", row.compared_with)
        if ours and bare and "xpos" not in row.what:
            speeds = [int(match[1].replace(",", "")) for match in (ours, bare)]
            found.append((row.what.split(", native")[0].split(", 2 threads")[0], *speeds))
    figure = Figure(figsize=(8.0, 0.55 * len(found) + 0.9), layout="constrained")
    axes = figure.subplots()
    for place, (name, ours, bare) in enumerate(reversed(found)):
        axes.barh(place + 0.2, ours, 0.36, color=_BLUE, label="env.step" if place == 0 else None)
        axes.barh(place - 0.2, bare, 0.36, color=_GRAY, label="bare loop" if place == 0 else None)
        axes.text(max(ours, bare) * 1.05, place, f"{ours / bare:.2f}", va="center", fontsize=9)
        axes.text(900, place, name, ha="right", va="center", fontsize=9)
    axes.set_xscale("log")
    fastest = max(speed for _, *speeds in found for speed in speeds)
    axes.set_xlim(1000, max(500_000, 2 * fastest))
    axes.set_yticks([])
    axes.set_xlabel("environment steps per second (number: ratio of the two)")
    axes.legend(loc="lower right", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    print(write_page())
