"""Look at what led to a NaN, in the browser: `uv run viz-nan DUMP`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import first_and_flags, parse_flags, run_command

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
    dump, flags = first_and_flags(argv, _USAGE, "dump", argv)
    from mjlab.scripts.viz_nan_run import VizNanConfig, run_viz_nan

    run_viz_nan(dump, parse_flags(VizNanConfig, VizNanConfig(), flags, "viz-nan DUMP"))


def main() -> None:
    """Entry point of `viz-nan`."""
    run_command(_command)


if __name__ == "__main__":
    main()
