"""README of a bundle: what to measure, what to command, and how to connect a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

_TEMPLATE = Path(__file__).parent / "files" / "README.md.txt"


_HEADING = """

The reference motion has a heading in the world, and an IMU starts with any. When `hand_over` is done, turn
all further orientations by the difference of yaw, once computed: left-multiply them by (cos d/2, 0, 0,
sin d/2), with d = yaw(`body_quat_w[0, anchor_index]` of `motion.npz`) - yaw(measured), and
yaw(w, x, y, z) = atan2(2 (w z + x y), 1 - 2 (y y + z z))."""


def readme(contract: Mapping[str, Any], notes: Sequence[str]) -> str:
    """Return the README, in Markdown.

    Args:
        contract: Content of `contract.json`.
        notes: What the user should know, one sentence each.
    """
    rates, task = contract["rates"], contract["source"]["task"]
    given = [command for command in contract["commands"] if command["kind"] == "given"]
    example = [f"{_middle(one):g}" for one in _components(given)] or ["0"]
    listed = "".join(f"- {note}\n" for note in notes)
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        title=f"{task}, deployed",
        task=task,
        rate=f"{1.0 / rates['step_dt']:g} Hz",
        mujoco=contract["source"].get("mujoco", ""),
        example=" ".join(example),
        measurements=_table(
            ("name", "size", "unit", "frame", "origin"),
            [
                (
                    f"`{one['name']}`",
                    " x ".join(map(str, one["shape"])),
                    one["unit"] or "-",
                    one["frame"] or "-",
                    one["why"],
                )
                for one in contract["measurements"]
            ],
        ),
        joints=", ".join(joint["name"] for joint in contract["joints"]),
        heading=_HEADING if any(c["kind"] == "motion" for c in contract["commands"]) else "",
        commands=_commands(contract["commands"]),
        notes=f"\n## Notes\n\n{listed}\n" if listed else "\n",
    )


def _components(commands: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [one for command in commands[:1] for one in command["components"]]


def _middle(component: Mapping[str, Any]) -> float:
    """Return half of the upper bound, within the range; 0 without one."""
    low, high = component["range"] or (0.0, 0.0)
    return max(low, 0.5 * high)


def _commands(commands: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for command in commands:
        if command["kind"] != "given":
            rows.append((f"`{command['name']}`", f"computed: {command['kind']}", "-", "-"))
            continue
        for one in command["components"]:
            bounds = one["range"]
            text = "-" if bounds is None else f"{bounds[0]:.3g} to {bounds[1]:.3g}"
            rows.append((f"`{command['name']}`", one["name"], one["unit"] or "-", text))
    return _table(("command", "component", "unit", "range of training"), rows) if rows else "None."


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
