"""Evaluations of policies in files, as `evaluate --output` writes them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjlab.runs.settings import warn_unreadable
from mjlab.utils.logging import print_notice
from mjlab.utils.os import regular_file
from mjlab.utils.string import command_line

EVALUATION_FILE = "evaluation.json"
"""File of the evaluation, in the folder of a policy."""


def read_evaluation(path: Path, task: str, policy: Path) -> dict[str, Any] | None:
    """Return the evaluation in `path`; None if there is none, or one of another task or policy.

    Policies are compared by the names of their files, because folders can be moved.
    """
    try:
        found = json.loads(regular_file(path).read_text(encoding="utf-8"))
        measured = found["task"], Path(found["policy"]).name
        evaluation_rows(found)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        warn_unreadable(path, error)
        return None
    if measured != (task, policy.name):
        print_notice(
            f"{path} left out: expected an evaluation of {policy.name} in {task}, got one of "
            f"{measured[1]} in {measured[0]}."
        )
        return None
    return found


def evaluation_command(task: str, policy: Path, profile: str | None = None) -> str:
    """Return the command that evaluates a policy and writes the file."""
    words = ["evaluate", task, "--checkpoint-file", str(policy)]
    words += [] if profile is None else ["--profile", profile]
    words += ["--output", str(policy.parent / EVALUATION_FILE)]
    return command_line(["uv", "run", "mjlab", *words])


def evaluation_rows(evaluation: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return name, value and 95 % interval of what was measured, as text."""
    # Imports torch.
    from mjlab.rl.evaluation import SHARE

    rows = [_row("mean return", evaluation["mean_return"], evaluation["return_interval"])]
    for name in ("success_rate", "failure_rate"):
        if (rate := evaluation[name]) is not None:
            rows.append(
                _row(
                    name.replace("_", " "), rate, evaluation[name.replace("rate", "interval")], "%"
                )
            )
    for name, value in evaluation["metrics"].items():
        unit = evaluation["units"].get(name, "")
        of = name.removesuffix(SHARE)
        if of != name and of in evaluation.get("standing_still", {}):
            name, unit = f"{of}, share of standing still", "%"
        rows.append(_row(name, value["mean"], value["interval"], unit))
    return rows


def _row(
    name: str, value: float, interval: Sequence[float] | None, unit: str = ""
) -> tuple[str, str, str]:
    scale, form = (100.0, ".1f") if unit == "%" else (1.0, ",.4g")
    if abs(value) >= 1000.0:
        form = ",.0f"
    texts = [f"{scale * number:{form}}" for number in (value, *(interval or ()))]
    within = "" if interval is None else f"{texts[1]} to {texts[2]}"
    return name, f"{texts[0]} {unit}".rstrip(), within
