"""Write `docs/reference/causes.md`: the planted mistakes of the tests, and what `check-deploy` prints of them.

uv run python tools/causes_page.py
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from pathlib import Path
from typing import Any

from mjlab.deploy.check import check_bundle

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "reference" / "causes.md"
HEAD = """# Mistakes that check-deploy names

`tools/causes_page.py` wrote this page: each mistake was planted into a copy of a bundle, by an edit
of its `runtime.py`, `simulate.py`, contract, scene or network, and
[`check-deploy`](../how-to/check_deploy.md) was run on it. `tests/deploy/test_causes.py` has the
edits. Bundles, of 120 steps: `go1` and `g1` of the bundled policies; `odd`, a Go1 with clips,
scales, histories, explicit motors and a recurrent network; `geared`, a cart with a geared servo.

| | mistake | bundle | first difference | printed cause |
| --- | --- | --- | --- | --- |
"""


def row(number: int, plant: Any, folder: Path) -> str:
    """Return the row of a mistake that is planted in `folder`."""
    plant.edit(folder)
    report = check_bundle(folder)
    if not plant.cause:
        (where,) = [text for text in report.undecided if "never reached" in text]
        shown = ["none", f"not decidable by this trace: {where}"]
    else:
        first = str(report.findings[0]).splitlines()
        shown = [first[0].rstrip("."), first[1].removeprefix("  Likely cause: ").rstrip(".")]
    return f"| {number} | {plant.mistake} | `{plant.bundle}` | {shown[0]} | {shown[1]} |"


def main() -> None:
    """Check all mistakes, and write the page."""
    sys.path.insert(0, str(ROOT / "tests" / "deploy"))
    tests, rows = importlib.import_module("test_causes"), []
    with tempfile.TemporaryDirectory() as temporary:
        for number, plant in enumerate(tests.PLANTS, 1):
            bundle = Path(temporary) / plant.bundle
            if not bundle.exists():
                tests.write_traced(plant.bundle, bundle)
            copy = tests.copied(bundle, Path(temporary) / f"copy {number}")
            rows.append(row(number, plant, copy))
            print(rows[-1], flush=True)
    PAGE.write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
