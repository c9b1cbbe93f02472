"""Options of the trials, and the table of their results."""

from __future__ import annotations

from pathlib import Path

import pytest

from .trials import RESULTS, table

MINUTES = 15.0


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("robustness", "trials, with -m robustness")
    group.addoption("--parts", nargs="+", metavar="FAMILY", help="families (default: all)")
    group.addoption("--seed", type=int, default=0, help="seed of all trials (default: 0)")
    group.addoption(
        "--minutes", type=float, default=MINUTES, help="scales the numbers of trials (default: 15)"
    )
    group.addoption("--trial", type=int, help="only this trial, and what its commands print")
    group.addoption("--out", type=Path, help="Markdown file to write the table to")


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    results = config.stash.get(RESULTS, [])
    if not results:
        return
    text = table(results, config.getoption("--seed"))
    terminalreporter.write_line(f"\n{text}")
    if (out := config.getoption("--out")) is not None:
        out.write_text(text)
