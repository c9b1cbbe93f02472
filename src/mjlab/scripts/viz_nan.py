"""Look at what led to a NaN, in the browser: `uv run viz-nan DUMP`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import UserError, parse_flags, run_command

if TYPE_CHECKING:
    from mjlab.scripts.viz_nan_run import VizNanConfig as VizNanConfig

_USAGE = """\
usage: viz-nan DUMP [flags]

Show the states that led to a NaN. DUMP is what `train --enable-nan-guard True` wrote when one
appeared, such as nan_dump_latest.npz; the model is read from the same folder.

example:
    uv run viz-nan /tmp/mjlab/nan_dumps/nan_dump_latest.npz

flags:
    --host ADDRESS      address to serve on; 0.0.0.0 is the whole network (default: 127.0.0.1)
    --port N            port to serve on; the next free one where it is taken (default: 8080)"""


def __getattr__(name: str) -> Any:
    if name in ("VizNanConfig", "run_viz_nan"):
        from mjlab.scripts import viz_nan_run

        return getattr(viz_nan_run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _command(argv: list[str]) -> None:
    if not argv or {"-h", "--help"} & set(argv):
        print(_USAGE)
        sys.exit(0)
    if argv[0].startswith("-"):
        raise UserError(f"The dump comes first, before {argv[0]!r}.\n\n{_USAGE}")
    from mjlab.scripts.viz_nan_run import VizNanConfig, run_viz_nan

    run_viz_nan(argv[0], parse_flags(VizNanConfig, VizNanConfig(), argv[1:], "viz-nan DUMP"))


def main() -> None:
    """Entry point of `viz-nan`."""
    run_command(_command)


if __name__ == "__main__":
    main()
