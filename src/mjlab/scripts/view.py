"""Show a model in the browser: `uv run mjlab view robot.xml`, also URDF, a robot or a task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco

from mjlab.cli.flags import parse_flags
from mjlab.scripts.export_scene import ROBOTS, scene_and_options
from mjlab.utils.errors import MjlabError, UserError
from mjlab.utils.urdf import read_urdf
from mjlab.viewer.page_server import check_address, open_browser, page_url, serve_page
from mjlab.viewer.viser.model_page import ModelPage

_SUFFIXES = (".xml", ".urdf", ".mjb", ".mjz", ".zip")


@dataclass(frozen=True)
class ViewConfig:
    """Flags of `view`."""

    host: str = "127.0.0.1"
    """Address of the page. `0.0.0.0`: all interfaces."""
    port: int = 8080
    """Port of the page; the next free port if taken."""
    open_browser: bool = True
    """Open the page in the browser of this machine."""
    check: bool = False
    """Print the findings of `mjlab check` first."""


def command(argv: list[str], prog: str) -> None:
    """Run `mjlab view`."""
    target, *flags = argv
    run_view(target, parse_flags(ViewConfig, ViewConfig(), flags, f"{prog} MODEL"))


def run_view(target: str, cfg: ViewConfig) -> None:
    """Serve the page of a model until Ctrl-C.

    Raises:
        UserError: the model cannot be found or compiled.
        ValueError: invalid address.
    """
    check_address(cfg.host, cfg.port, "--")
    model = load_model(target)
    if cfg.check:
        from mjlab.scripts.check import check, report

        print(report(target, check(target)), end="\n\n", flush=True)
    server = serve_page(cfg.host, cfg.port)
    page = ModelPage(server, target, model, lambda: load_model(target))
    print(f"Open {page_url(server)} in a browser. Ctrl-C ends.", flush=True)
    if cfg.open_browser:
        open_browser(page_url(server))
    try:
        page.run()
    finally:
        server.stop()


def load_model(target: str) -> mujoco.MjModel:
    """Return the model of a file, robot or task, with a floor if it would fall forever.

    Args:
        target: Path of an MJCF, URDF, MJB or MuJoCo archive; a robot (g1, go1, yam or
            `module:function`); or the name of a task.

    Raises:
        UserError: not found, or MuJoCo cannot compile it; the message has the path and the reason.
    """
    path = Path(target)
    if path.suffix.lower() in _SUFFIXES or path.is_file():
        return _load_file(path)
    from mjlab.scene import Scene
    from mjlab.terrains import TerrainEntityCfg

    try:
        scene_cfg, physics = scene_and_options(target)
    except MjlabError as error:
        raise UserError(
            f"View {target!r}: expected a file ({', '.join(_SUFFIXES)}), a robot ({', '.join(ROBOTS)} or "
            f"module:function) or a task, found none. {error}"
        ) from None
    if scene_cfg.terrain is None:
        scene_cfg.terrain = TerrainEntityCfg(terrain_type="plane")
    scene = Scene(scene_cfg, "cpu")
    options: Any = SimpleNamespace(opt=scene.spec.option)
    physics.apply(options)
    return scene.compile()


def _load_file(path: Path) -> mujoco.MjModel:
    if not path.is_file():
        raise UserError(f"View {path}: expected a file ({', '.join(_SUFFIXES)}), found none.")
    if path.suffix.lower() not in _SUFFIXES:
        raise UserError(
            f"View {path}: expected a name that ends in {', '.join(_SUFFIXES)}; rename it."
        )
    try:
        if path.suffix.lower() == ".mjb":
            return mujoco.MjModel.from_binary_path(str(path))
        is_urdf = path.suffix.lower() == ".urdf"
        spec = read_urdf(path) if is_urdf else mujoco.MjSpec.from_file(str(path))
        # A robot without ground would fall out of view once the physics runs.
        is_free = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints)
        if is_free and not spec.worldbody.geoms:
            floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE)
            floor.size = (10.0, 10.0, 0.1)
        model = spec.compile()
        # Names in another encoding cannot be shown.
        model.names.decode()
        return model
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path}: MuJoCo cannot load the model: {reason}") from error
