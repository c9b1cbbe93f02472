"""A page in the browser that shows a terrain, and changes it by sliders."""

from __future__ import annotations

import threading
from typing import Any

import viser

from mjlab.scripts.terrain_knobs import Knob, RobotName, knobs_of, with_values
from mjlab.scripts.terrain_scene import TerrainScene, build_terrain_scene
from mjlab.terrains import SubTerrainCfg
from mjlab.terrains.config import ALL_TERRAIN_PRESETS
from mjlab.viewer.camera import CameraView
from mjlab.viewer.viser.scene import MjlabViserScene

ALL = "all"
ROBOTS: tuple[RobotName, ...] = ("unitree_go1", "unitree_g1", "none")


class TerrainPage:
    """Shows one preset, or all of them side by side, at rising difficulty along x.

    The page's controls only ask for a new terrain; it is built in the thread that calls `run`.
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
        """Add the controls. The terrain is built by `rebuild`.

        Args:
            server: The page's server.
            terrain: Preset to show first, or `all`.
            num_levels: Number of difficulties.
            size: Extent of each cell, in metres.
            seed: Seed of the terrain.
            robot: Robot that stands at the origin of each cell.
        """
        self.server = server
        self.scene: TerrainScene | None = None
        """What is shown, or None before the first `rebuild`."""
        self._changed = threading.Event()
        self._changed.set()
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
        # The sliders, and which preset they belong to, change together.
        self._lock = threading.Lock()
        self._handles: dict[str, Any] = {}
        self._preset = terrain
        for handle in (self._levels, self._size, self._seed, self._robot):
            handle.on_update(self._ask)
        self._terrain.on_update(self._choose)
        self._add_knobs()

    @property
    def status(self) -> str:
        """The text above the controls: what is shown, or why it cannot be."""
        return self._status.content

    def run(self) -> None:
        """Show what is asked for, until Ctrl-C."""
        while True:
            if self._changed.wait(timeout=0.2):
                self.rebuild()

    def rebuild(self) -> None:
        """Build and show the terrain that the controls describe; the last one if it cannot be."""
        self._changed.clear()
        self._status.content = "Building ..."
        try:
            scene = build_terrain_scene(
                self._kinds(), self._size.value, self._levels.value, self._seed.value,
                self._robot.value,
            )  # fmt: skip
        except ValueError as error:
            self._status.content = f"**This terrain cannot be built.** {error}"
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
            # Where the person looks from is theirs, unless the grid is another one.
            if (levels, kinds, size) != self._aimed_at:
                shown.aim()
        self._aimed_at = (levels, kinds, size)

    # Controls. They are called from the server's threads.

    def _ask(self, _: Any = None) -> None:
        self._changed.set()

    def _choose(self, _: Any) -> None:
        self._add_knobs()
        self._ask()

    def _add_knobs(self) -> None:
        """Replace the sliders by those of the chosen preset."""
        with self._lock, self._folder:
            for handle in self._handles.values():
                handle.remove()
            self._handles, self._preset = {}, self._terrain.value
            if self._preset == ALL:
                return
            for knob in knobs_of(ALL_TERRAIN_PRESETS[self._preset]()):
                handle = self._add_knob(knob)
                handle.on_update(self._ask)
                self._handles[knob.field] = handle

    def _add_knob(self, knob: Knob) -> Any:
        gui, label = self.server.gui, knob.field
        if knob.kind == "switch":
            return gui.add_checkbox(label, knob.value)
        if knob.kind == "choice":
            return gui.add_dropdown(label, knob.options, initial_value=knob.value)
        if knob.kind == "count":
            return gui.add_slider(label, int(knob.low), int(knob.high), 1, knob.value)
        step = (knob.high - knob.low) / 200
        if knob.kind == "range":
            return gui.add_multi_slider(label, knob.low, knob.high, step, knob.value)
        return gui.add_slider(label, knob.low, knob.high, step, knob.value)
