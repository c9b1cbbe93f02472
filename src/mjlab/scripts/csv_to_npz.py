"""Turn joint angles into a motion: `python -m mjlab.scripts.csv_to_npz --input-file FILE`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.compat import older_names
from mjlab.scripts.cli import run_command

if TYPE_CHECKING:
    from mjlab.scripts.csv_to_npz_run import CsvToNpzConfig as CsvToNpzConfig

_USAGE = """usage: python -m mjlab.scripts.csv_to_npz --input-file FILE [flags]

Turn a CSV of the retargeted LAFAN1 sets (one pose a line: position of the root, its quaternion x y z w,
all joint angles) into the .npz that motion tracking reads; or an .npz into one of another rate.

    python -m mjlab.scripts.csv_to_npz --input-file dance1_subject2.csv
    python -m mjlab.scripts.csv_to_npz --input-file dance.csv --line-range "(120,720)" \\
        --output-file dance.npz --render True
    python -m mjlab.scripts.csv_to_npz --input-file dance.csv --view True

`--help` with another flag lists all flags."""


def __getattr__(name: str) -> Any:
    if name in ("CsvToNpzConfig", "convert"):
        from mjlab.scripts import csv_to_npz_run

        return getattr(csv_to_npz_run, name)
    return older_names(__name__)(name)


def _command(argv: list[str]) -> None:
    if not argv or argv in (["-h"], ["--help"]):
        print(_USAGE)
        return
    from mjlab.scripts.cli import parse_flags
    from mjlab.scripts.csv_to_npz_run import CsvToNpzConfig, convert

    convert(parse_flags(CsvToNpzConfig, CsvToNpzConfig(), argv, prog="csv_to_npz"))


def main() -> None:
    """Entry point."""
    run_command(_command)


if __name__ == "__main__":
    main()
