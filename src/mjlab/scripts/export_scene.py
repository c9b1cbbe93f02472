"""Export the scene of a task, or a robot, as MuJoCo XML: `uv run mjlab export-scene TARGET [flags]`."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from mjlab.cli.flags import parse_flags
from mjlab.cli.main import run_alias
from mjlab.utils.errors import UserError
from mjlab.utils.signals import raising_interrupted
from mjlab.utils.string import suggest

if TYPE_CHECKING:
    from mjlab.entity import EntityCfg
    from mjlab.scene import Scene, SceneCfg
    from mjlab.sim import MujocoCfg

ROBOTS = {"g1": "get_g1_robot_cfg", "go1": "get_go1_robot_cfg", "yam": "get_yam_robot_cfg"}
"""Functions of `mjlab.asset_zoo.robots` by short robot name."""

_XML, _ASSETS = "scene.xml", "assets"


@dataclass(frozen=True)
class ExportSceneConfig:
    """Flags of `export-scene`."""

    output_dir: str = "export"
    """Output folder. Must be new or empty."""
    zip: bool = False
    """Write the archive `<output_dir>.zip` instead of a folder."""
    overwrite: bool = False
    """Replace an earlier export; other files are kept."""


def command(argv: list[str], prog: str) -> None:
    """Run `export-scene`."""
    target, *flags = argv
    cfg = parse_flags(ExportSceneConfig, ExportSceneConfig(), flags, f"{prog} TARGET")
    run_export_scene(target, cfg)


def run_export_scene(target: str, cfg: ExportSceneConfig) -> Path:
    """Write the scene of `target` and return the folder or archive.

    The file contains the physics options (timestep, solver, cone, ...) of the environment.

    Raises:
        UserError: unknown target, or the output exists.
    """
    from mjlab.scene import Scene

    scene_cfg, options = scene_and_options(target)
    folder, result = _destination(cfg)
    scene = Scene(scene_cfg, "cpu")
    target_options: Any = SimpleNamespace(opt=scene.spec.option)
    scene.report_overruled_options(options)
    options.apply(target_options)
    # Signals must leave no temporary files.
    with raising_interrupted():
        if cfg.zip:
            scene.write(folder, zip=True)
        else:
            _write_folder(scene, folder)
    print(f"Wrote {result if cfg.zip else folder / _XML}.")
    return result


def scene_and_options(target: str) -> tuple[SceneCfg, MujocoCfg]:
    """Return scene and physics options of a task, or of a robot (see `robot_cfg`).

    Raises:
        UserError: unknown target.
    """
    from mjlab.scene import SceneCfg
    from mjlab.sim import MujocoCfg

    if ":" in target or target in ROBOTS:
        return SceneCfg(entities={"robot": robot_cfg(target)}), MujocoCfg()
    from mjlab.tasks.registry import UnknownTaskError, load_env_cfg

    try:
        env_cfg = load_env_cfg(target)
    except UnknownTaskError as error:
        raise UserError(
            f"{error} The target may also be a robot ({', '.join(ROBOTS)}) or module:function."
        ) from None
    return env_cfg.scene, env_cfg.sim.mujoco


def robot_cfg(name: str) -> EntityCfg:
    """Return the config of a robot: short name, or `module:function` that returns an EntityCfg.

    Raises:
        UserError: unknown name, failed import, or not an EntityCfg.
    """
    from mjlab.entity import EntityCfg

    made = made_robot(name)
    if not isinstance(made, EntityCfg):
        raise UserError(
            f"{name!r}: expected a function that returns an EntityCfg, got {type(made).__name__}."
        )
    return made


def made_robot(name: str) -> Any:
    """Return what the function of a robot returns: that of a short name, or `module:function`.

    Raises:
        UserError: unknown name, or failed import.
    """
    module, colon, function = name.partition(":")
    if not colon:
        if name not in ROBOTS:
            raise UserError(
                f"Unknown robot {name!r}; {suggest(name, ROBOTS)} Or use module:function, a function that "
                "returns an EntityCfg."
            )
        module, function = "mjlab.asset_zoo.robots", ROBOTS[name]
    if os.getcwd() not in sys.path:
        # As `python -m` does: modules in the working folder can be imported.
        sys.path.append(os.getcwd())
    try:
        make = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"{name!r} cannot be imported: {error}.") from error
    return make() if callable(make) else make


def _destination(cfg: ExportSceneConfig) -> tuple[Path, Path]:
    """Return the folder to write, and the resulting folder or archive. Raises if the latter is taken."""
    folder = Path(cfg.output_dir)
    if cfg.zip:
        folder = folder.with_suffix("") if folder.suffix == ".zip" else folder
        # An archive needs a name; the paths `.`, `..` and `/` have none.
        folder = folder.resolve() if folder.name in ("", "..") else folder
    result = folder.with_name(f"{folder.name}.zip") if cfg.zip else folder
    is_taken = result.exists() and (cfg.zip or any(result.iterdir()))
    if is_taken and not cfg.overwrite:
        taken = f"archive {result} exists" if cfg.zip else f"folder {result} is not empty"
        raise UserError(
            f"--output-dir: {taken}; use another folder, or --overwrite True to replace an earlier "
            "export."
        )
    return folder, result


def _write_folder(scene: Scene, folder: Path) -> None:
    """Write the scene into a temporary folder and rename, so that `folder` never holds half an export."""
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".export-") as temporary:
            made = Path(temporary) / "scene"
            scene.write(made)
            if (folder / _ASSETS).exists():
                (folder / _ASSETS).rename(Path(temporary) / "earlier")
            for name in (_ASSETS, _XML):
                if (made / name).exists():
                    (made / name).replace(folder / name)
    finally:
        if is_new:
            # Only if it is empty.
            with contextlib.suppress(OSError):
                folder.rmdir()


def main() -> None:
    """Entry point of `export-scene`."""
    run_alias("export-scene")


if __name__ == "__main__":
    main()
