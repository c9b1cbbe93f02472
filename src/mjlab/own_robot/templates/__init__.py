"""Templates of the files of a written package, with `$placeholders`."""

from __future__ import annotations

from pathlib import Path
from string import Template


def template(name: str) -> Template:
    """Return the template of a file, such as `robot.py`."""
    return Template((Path(__file__).parent / f"{name}.txt").read_text(encoding="utf-8"))
