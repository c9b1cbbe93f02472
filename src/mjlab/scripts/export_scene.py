"""Write a task's scene, or a robot, as MuJoCo XML: `uv run export-scene TARGET [flags]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import first_and_flags, parse_flags, run_command

if TYPE_CHECKING:
    from mjlab.scripts.export_scene_run import ExportSceneConfig as ExportSceneConfig

_USAGE = """\
usage: export-scene TARGET [flags]

Write scene.xml and the files it refers to, for MuJoCo's own viewer and other programs.

TARGET is the name of a task (`list-envs`), a robot (g1, go1, yam), or module:function, a function
that returns an EntityCfg.

examples:
    uv run export-scene Mjlab-Velocity-Flat-Unitree-Go1 --output-dir go1_flat
    uv run export-scene g1 --zip

flags:
    --output-dir DIR    folder to write into, which must be new or empty (default: export)
    --zip               write the archive DIR.zip instead of a folder
    --overwrite         replace an earlier export there; other files are left alone"""


def __getattr__(name: str) -> Any:
    if name in ("ExportSceneConfig", "run_export_scene"):
        from mjlab.scripts import export_scene_run

        return getattr(export_scene_run, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _command(argv: list[str]) -> None:
    target, flags = first_and_flags(argv, _USAGE, "target", argv)
    from mjlab.scripts.export_scene_run import ExportSceneConfig, run_export_scene

    cfg = parse_flags(ExportSceneConfig, ExportSceneConfig(), flags, "export-scene TARGET")
    run_export_scene(target, cfg)


def main() -> None:
    """Entry point of `export-scene`."""
    run_command(_command)


if __name__ == "__main__":
    main()
