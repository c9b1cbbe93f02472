"""Export the scene of a task, or a robot, as MuJoCo XML: `uv run export-scene TARGET [flags]`."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from mjlab.scripts.cli import run_alias
from mjlab.scripts.flags import parse_flags
from mjlab.utils.errors import UserError

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

    scene_cfg, options = _load(target)
    folder, result = _destination(cfg)
    scene = Scene(scene_cfg, "cpu")
    target_options: Any = SimpleNamespace(opt=scene.spec.option)
    scene.report_overruled_options(options)
    options.apply(target_options)
    if cfg.zip:
        scene.write(folder, zip=True)
    else:
        _write_folder(scene, folder)
    print(f"Wrote {result if cfg.zip else folder / _XML}.")
    return result


def _load(target: str) -> tuple[SceneCfg, MujocoCfg]:
    """Return scene and physics options of a task, a robot (short name) or `module:function`."""
    from mjlab.scene import SceneCfg
    from mjlab.sim import MujocoCfg

    if ":" in target:
        return SceneCfg(entities={"robot": _from_function(target)}), MujocoCfg()
    if target in ROBOTS:
        from mjlab.asset_zoo import robots

        make: Callable[[], EntityCfg] = getattr(robots, ROBOTS[target])
        return SceneCfg(entities={"robot": make()}), MujocoCfg()
    from mjlab.tasks.registry import UnknownTaskError, load_env_cfg

    try:
        env_cfg = load_env_cfg(target)
    except UnknownTaskError as error:
        raise UserError(
            f"{error} The target may also be a robot ({', '.join(ROBOTS)}) or module:function."
        ) from None
    return env_cfg.scene, env_cfg.sim.mujoco


def _needs_arguments(make: Callable[..., Any]) -> bool:
    try:
        inspect.signature(make).bind()
    except TypeError:
        return True
    except ValueError:
        # Functions of extension modules may lack a signature.
        return False
    return False


def _from_function(target: str) -> EntityCfg:
    from mjlab.entity import EntityCfg

    module_name, _, name = target.partition(":")
    if os.getcwd() not in sys.path:
        # As `python -m` does: modules in the working folder can be imported.
        sys.path.append(os.getcwd())
    try:
        make = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"{target!r} cannot be imported: {error}.") from error
    if callable(make) and _needs_arguments(make):
        raise UserError(
            f"{target!r}: expected a function without required arguments that returns an EntityCfg."
        )
    made = make() if callable(make) else make
    if not isinstance(made, EntityCfg):
        raise UserError(
            f"{target!r}: expected a function that returns an EntityCfg, got {type(made).__name__}."
        )
    return made


def _destination(cfg: ExportSceneConfig) -> tuple[Path, Path]:
    """Return the folder to write, and the resulting folder or archive. Raises if the latter is taken."""
    folder = Path(cfg.output_dir)
    if cfg.zip:
        folder = folder.with_suffix("") if folder.suffix == ".zip" else folder
        # An archive needs a name; the paths `.`, `..` and `/` have none.
        folder = folder.resolve() if folder.name in ("", "..") else folder
        if not folder.name:
            raise UserError(
                f"--output-dir: expected a path with a name for the archive, got {cfg.output_dir}."
            )
    result = folder.with_name(f"{folder.name}.zip") if cfg.zip else folder
    if not cfg.zip and result.exists() and not result.is_dir():
        raise UserError(f"--output-dir: expected a folder, got the file {result}.")
    is_free = not result.exists() or (result.is_dir() and not any(result.iterdir()))
    if not is_free and not cfg.overwrite:
        taken = f"archive {result} exists" if cfg.zip else f"folder {result} is not empty"
        raise UserError(
            f"--output-dir: {taken}; use another folder, or --overwrite True to replace an earlier "
            "export."
        )
    return folder, result


def _write_folder(scene: Scene, folder: Path) -> None:
    """Write the scene into a temporary folder and rename, so that `folder` never holds half an export."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".export-") as temporary:
        made = Path(temporary) / "scene"
        scene.write(made)
        if (folder / _ASSETS).exists():
            (folder / _ASSETS).rename(Path(temporary) / "earlier")
        for name in (_ASSETS, _XML):
            if (made / name).exists():
                (made / name).replace(folder / name)


def main() -> None:
    """Entry point of `export-scene`."""
    run_alias("export-scene")


if __name__ == "__main__":
    main()
