"""Check a bundle against its golden trace: `mjlab check-deploy FOLDER [flags]`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from mjlab.cli.flags import parse_flags
from mjlab.deploy.check import check_bundle
from mjlab.deploy.logs import check_answers, check_log
from mjlab.utils.errors import UserError


@dataclass(frozen=True)
class CheckDeployConfig:
    """Flags of `check-deploy`."""

    log: str | None = None
    """Log of a robot (CSV) to compare instead: terms, action and target are recomputed from its raw
    columns."""
    answers: str | None = None
    """Answers of another program to `golden.csv` (CSV) to compare instead."""
    json: bool = False
    """Print JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `check-deploy`; exits with status 1 at a difference."""
    target, *flags = argv
    cfg = parse_flags(CheckDeployConfig, CheckDeployConfig(), flags, f"{prog} FOLDER")
    if cfg.log is not None and cfg.answers is not None:
        raise UserError("check-deploy: expected --log or --answers, got both; use two calls.")
    if cfg.log is not None:
        report = check_log(Path(target), Path(cfg.log))
    elif cfg.answers is not None:
        report = check_answers(Path(target), Path(cfg.answers))
    else:
        report = check_bundle(Path(target))
    print(json.dumps(report.as_dict(), indent=2) if cfg.json else report)
    if not report.is_passed:
        raise SystemExit(1)
