"""Check a bundle against its golden trace: `uv run mjlab check-deploy FOLDER [flags]`."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

from mjlab.cli.flags import parse_flags
from mjlab.deploy.check import Report, check_bundle
from mjlab.deploy.logs import TOLERANCE, check_answers, check_log
from mjlab.utils.errors import UserError
from mjlab.utils.ranges import Count, Positive
from mjlab.utils.screen import shown


@dataclass(frozen=True)
class CheckDeployConfig:
    """Flags of `check-deploy`."""

    log: str | None = None
    """Log of a robot (CSV) to compare instead: terms, action and target are recomputed from its raw
    columns."""
    answers: str | None = None
    """Answers of another program to `golden.csv` (CSV) to compare instead."""
    tolerance: Positive = TOLERANCE
    """Largest difference that is none in a log or in answers, as a fraction of the range of the values;
    1e-4 for logs with 5 decimals."""
    strict: bool = False
    """Exit with status 1 after warnings, too."""
    stress: bool = False
    """Write a passport: success with latency, noise, friction, other gains and masses, payload, pushes."""
    output: str = field(default="passport.html", metadata=shown("stress", "FILE"))
    """Page of the passport; JSON is written beside it."""
    episodes: Count = field(default=20, metadata=shown("stress", "N"))
    """Episodes at each level."""
    seconds: Positive = field(default=6.0, metadata=shown("stress", "S"))
    """Duration of an episode (s)."""
    json: bool = False
    """Print JSON."""


def command(argv: list[str], prog: str) -> None:
    """Run `check-deploy`; exits with status 1 at a difference."""
    target, *flags = argv
    cfg = parse_flags(CheckDeployConfig, CheckDeployConfig(), flags, f"{prog} FOLDER")
    report = _report(Path(target), cfg)
    print(json.dumps(report.as_dict(), indent=2) if cfg.json else report)
    if cfg.stress:
        # A passport is of the bundle, not of a log.
        is_of_bundle = cfg.log is None and cfg.answers is None
        _stress(Path(target), report if is_of_bundle else check_bundle(Path(target)), cfg)
    if not report.is_passed or (cfg.strict and report.warnings):
        raise SystemExit(1)


def _report(folder: Path, cfg: CheckDeployConfig) -> Report:
    if cfg.log is not None and cfg.answers is not None:
        raise UserError("check-deploy: expected --log or --answers, got both; use two calls.")
    if cfg.log is not None:
        return check_log(folder, Path(cfg.log), cfg.tolerance)
    if cfg.answers is not None:
        return check_answers(folder, Path(cfg.answers), cfg.tolerance)
    return check_bundle(folder)


def _stress(folder: Path, report: Report, cfg: CheckDeployConfig) -> None:
    """Write the passport."""
    from mjlab.deploy.evidence import Evidence
    from mjlab.deploy.passport import write_passport
    from mjlab.deploy.stress import stress

    evidence = Evidence(folder)
    # Standard output is the report, which may be JSON.
    curves = stress(
        evidence, cfg.episodes, cfg.seconds, report=lambda text: print(text, file=sys.stderr)
    )
    settings = {"seeds": f"0 to {cfg.episodes - 1}", "seconds": cfg.seconds}
    write_passport(Path(cfg.output), evidence.contract, report, curves, settings)
    print(f"Wrote {cfg.output} and {Path(cfg.output).with_suffix('.json')}.", file=sys.stderr)
