"""Page of generated terrain: `mjlab visualize-terrain`."""

from __future__ import annotations

import dataclasses
import threading
import typing
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
import viser

from mjlab.asset_zoo.robots import get_g1_robot_cfg, get_go1_robot_cfg
from mjlab.scene import Scene, SceneCfg
from mjlab.terrains import SubTerrainCfg, TerrainEntityCfg, TerrainGeneratorCfg
from mjlab.terrains.config import ALL_TERRAIN_PRESETS
from mjlab.utils.string import escaped
from mjlab.viewer.camera import CameraView
from mjlab.viewer.viser.scene import MjlabViserScene

RobotName = Literal["unitree_go1", "unitree_g1", "none"]
# Fields set by the page, or not representable by a slider.
_NOT_CONTROLS = {"proportion", "size", "flat_patch_sampling"}
# Pixel sizes: near 0 a height field would have millions of pixels.
_PIXELS = {"horizontal_scale", "vertical_scale", "resolution"}
ALL = "all"
ROBOTS: tuple[RobotName, ...] = ("unitree_go1", "unitree_g1", "none")


class TerrainPage:
    """Page that shows one preset, or all presets side by side, with difficulty increasing along x.

    Controls only request a new terrain; the thread that calls `run` builds the terrain.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        terrain: str = "pyramid_stairs",
        num_levels: int = 5,
        size: float = 8.0,
        seed: int = 0,
        robot: RobotName = "unitree_go1",
    ) -> None:
        """Add the controls. `rebuild` builds the terrain.

        Args:
            server: Server of the page.
            terrain: Preset to show first, or `all`.
            num_levels: Number of difficulty levels.
            size: Extent of each cell (m).
            seed: Seed of the terrain.
            robot: Robot placed at the origin of each cell.
        """
        self.server = server
        self.scene: TerrainScene | None = None
        """Current scene; None before the first `rebuild`."""
        self._changed = threading.Event()
        self._aimed_at: tuple[Any, ...] | None = None
        gui = server.gui
        self._status = gui.add_markdown("")
        self._terrain = gui.add_dropdown(
            "Terrain", (ALL, *ALL_TERRAIN_PRESETS), initial_value=terrain
        )
        self._levels = gui.add_slider("Difficulties", 1, 10, 1, initial_value=num_levels)
        self._size = gui.add_slider("Size (m)", 4.0, 16.0, 0.5, initial_value=size)
        self._seed = gui.add_number("Seed", initial_value=seed, min=0, step=1)
        self._robot = gui.add_dropdown("Robot", ROBOTS, initial_value=robot)
        self._folder = gui.add_folder("Parameters")
        # Sliders and preset must change together.
        self._lock = threading.Lock()
        self._handles: dict[str, Any] = {}
        self._preset = terrain
        for handle in (self._levels, self._size, self._seed, self._robot):
            handle.on_update(lambda _: self._changed.set())
        self._terrain.on_update(self._add_controls)
        self._add_controls()

    @property
    def status(self) -> str:
        """Status text: size of the terrain, or the build error."""
        return self._status.content

    def run(self) -> None:
        """Rebuild the terrain on request, until Ctrl-C."""
        while True:
            if self._changed.wait(timeout=0.2):
                self.rebuild()

    def rebuild(self) -> None:
        """Build and show the terrain set by the controls; keep the previous terrain on errors."""
        self._changed.clear()
        self._status.content = "Building ..."
        try:
            scene = build_terrain_scene(
                self._kinds(), self._size.value, self._levels.value, self._seed.value,
                self._robot.value,
            )  # fmt: skip
        except ValueError as error:
            self._status.content = f"**This terrain cannot be built.** {escaped(error)}"
            return
        self.scene = scene
        self._draw(scene)
        levels, kinds, _ = scene.origins.shape
        self._status.content = (
            f"{kinds} x {levels} terrains, {scene.model.ngeom} geoms, "
            f"{scene.num_polygons:,} polygons"
        )

    def _kinds(self) -> dict[str, SubTerrainCfg]:
        with self._lock:
            name = self._preset
            values = {field: handle.value for field, handle in self._handles.items()}
        if name == ALL:
            return {name: preset() for name, preset in ALL_TERRAIN_PRESETS.items()}
        return {name: with_values(ALL_TERRAIN_PRESETS[name](), values)}

    def _draw(self, scene: TerrainScene) -> None:
        levels, kinds, _ = scene.origins.shape
        size = self._size.value
        extent = max(levels, kinds) * size
        positions, rotations = scene.poses()
        with self.server.atomic():
            self.server.scene.reset()
            view = CameraView(None, (0.0, 0.0, 0.0), 0.8 * extent, 60.0, -35.0, None)
            shown = MjlabViserScene(self.server, scene.model, len(positions), view=view)
            shown.update_from_arrays(positions, rotations)
            # Keep the view of the user unless the grid has changed.
            if (levels, kinds, size) != self._aimed_at:
                shown.aim()
        self._aimed_at = (levels, kinds, size)

    def _add_controls(self, _: Any = None) -> None:
        """Replace the sliders by those of the selected preset, and request the preset."""
        with self._lock, self._folder:
            for handle in self._handles.values():
                handle.remove()
            self._handles, self._preset = {}, self._terrain.value
            if self._preset != ALL:
                preset = ALL_TERRAIN_PRESETS[self._preset]()
                self._handles = add_controls(self.server.gui, preset)
            for handle in self._handles.values():
                handle.on_update(lambda _: self._changed.set())
        self._changed.set()


# Terrain.


@dataclass(frozen=True)
class TerrainScene:
    """Compiled terrain with one robot, and the positions to draw the robot at."""

    model: mujoco.MjModel
    """Model of the terrain and the robot, if any."""
    origins: np.ndarray
    """Spawn points, (levels, kinds, 3)."""
    num_polygons: int
    """Number of triangles of the terrain surface."""

    def poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return body positions (n, nbody, 3) and rotations (n, nbody, 3, 3) for n origins."""
        data = mujoco.MjData(self.model)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, data, 0)
        mujoco.mj_kinematics(self.model, data)
        origins = self.origins.reshape(-1, 3)
        positions = np.repeat(data.xpos[None], len(origins), axis=0)
        # World and terrain are static.
        moving = self.model.body_weldid > 0
        positions[:, moving] += origins[:, None]
        return positions, np.repeat(data.xmat.reshape(1, -1, 3, 3), len(origins), axis=0)


def build_terrain_scene(
    kinds: dict[str, SubTerrainCfg], size: float, num_levels: int, seed: int, robot: RobotName
) -> TerrainScene:
    """Build a grid with one column per kind and rows of increasing difficulty.

    Args:
        kinds: Sub-terrains by name.
        size: Extent of each cell (m).
        num_levels: Number of rows.
        seed: Seed of the terrain.
        robot: Robot to place.

    Raises:
        ValueError: the terrain cannot be built.
    """
    generator = TerrainGeneratorCfg(
        seed=seed,
        curriculum=True,
        size=(size, size),
        num_rows=num_levels,
        border_width=1.0,
        sub_terrains=kinds,
        add_lights=True,
    )
    terrain = TerrainEntityCfg(terrain_type="generator", terrain_generator=generator)
    robots = {"unitree_go1": get_go1_robot_cfg, "unitree_g1": get_g1_robot_cfg}
    entities = {} if robot == "none" else {"robot": robots[robot]()}
    scene = Scene(SceneCfg(terrain=terrain, entities=entities), "cpu")
    model = scene.compile()
    return TerrainScene(model, scene["terrain"].terrain_origins.numpy(), count_polygons(model))


def count_polygons(model: mujoco.MjModel) -> int:
    """Return the number of triangles of the geoms of the body `terrain`."""
    total = 0
    for geom in np.flatnonzero(model.geom_bodyid == model.body("terrain").id):
        kind, shape = model.geom_type[geom], model.geom_dataid[geom]
        if kind == mujoco.mjtGeom.mjGEOM_HFIELD:
            total += 2 * int((model.hfield_nrow[shape] - 1) * (model.hfield_ncol[shape] - 1))
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            total += int(model.mesh_facenum[shape])
        else:
            # Box.
            total += 12
    return total


# Controls of config fields.


def add_controls(gui: viser.GuiApi, cfg: SubTerrainCfg) -> dict[str, Any]:
    """Add the controls of a config in field order and return them by field.

    Fields that are None have no control.
    """
    hints = typing.get_type_hints(type(cfg))
    names = [f.name for f in dataclasses.fields(cfg) if f.name not in _NOT_CONTROLS]
    controls = {n: _add_control(gui, n, getattr(cfg, n), hints[n]) for n in names}
    return {name: control for name, control in controls.items() if control is not None}


def _add_control(gui: viser.GuiApi, name: str, value: Any, hint: Any) -> Any:
    if isinstance(value, bool):
        return gui.add_checkbox(name, value)
    if typing.get_origin(hint) is Literal:
        return gui.add_dropdown(name, typing.get_args(hint), initial_value=value)
    if isinstance(value, int):
        return gui.add_slider(name, 1, 3 * max(value, 1), 1, value)
    if isinstance(value, tuple) and len(value) == 2:
        low, high = min(0.0, 2 * value[0]), max(2 * value[1], 0.1)
        return gui.add_multi_slider(name, low, high, (high - low) / 200, value)
    if isinstance(value, float):
        low, high = min(0.0, 2 * value), max(1.0, 2 * value)
        if name in _PIXELS:
            low, high = value / 2, 4 * value
        return gui.add_slider(name, low, high, (high - low) / 200, value)
    return None


def with_values(cfg: SubTerrainCfg, values: dict[str, Any]) -> SubTerrainCfg:
    """Return a copy of the config with the fields set to `values`."""
    typed = {name: tuple(v) if isinstance(v, (list, tuple)) else v for name, v in values.items()}
    return dataclasses.replace(cfg, **typed)
