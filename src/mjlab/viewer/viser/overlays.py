"""Overlays of the browser viewer for the environment in view: plots, cameras, drawings."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import mujoco
import viser

from mjlab.sensor import CameraSensor
from mjlab.viewer.viser.camera_viewer import ViserCameraViewer
from mjlab.viewer.viser.reward_bar_panel import RewardBarPanel
from mjlab.viewer.viser.term_plotter import ViserTermPlotter

if TYPE_CHECKING:
    from mjlab.viewer.viser.scene import MjlabViserScene

# Minimum wall time between updates of the plots, regardless of the step rate.
_REFRESH_PERIOD_S = 0.2


@dataclass
class ViserTermOverlays:
    """Rewards and metrics tabs of the environment in view."""

    server: viser.ViserServer
    env: Any
    """Unwrapped environment."""
    scene: MjlabViserScene
    frame_time: float
    """Time between two calls of `update` that record (s)."""
    reward_bar_max_terms: int = 20
    """Number of reward terms shown as bars."""
    reward_plotter: ViserTermPlotter | None = None
    reward_bar_panel: RewardBarPanel | None = None
    metrics_plotter: ViserTermPlotter | None = None
    _next_refresh: float = field(default=0.0, init=False, repr=False)

    def setup_tabs(self, tabs: viser.GuiTabGroupHandle) -> None:
        """Add a Rewards tab and, if the environment has metrics, a Metrics tab."""
        env_idx = self.scene.env_idx
        manager = self.env.reward_manager
        names = [name for name in manager.active_terms if self._has_weight(name)]
        with tabs.add_tab("Rewards", icon=viser.Icon.CHART_BAR):
            self.reward_bar_panel = RewardBarPanel(
                self.server,
                list(manager.active_terms),
                self.frame_time,
                self.reward_bar_max_terms,
                self._has_weight,
            )
            self.reward_plotter = ViserTermPlotter(self.server, names, "Reward", env_idx=env_idx)
        metrics: list[str] = list(self.env.metrics_manager.active_terms)
        if metrics:
            with tabs.add_tab("Metrics", icon=viser.Icon.CHART_LINE):
                self.metrics_plotter = ViserTermPlotter(
                    self.server, metrics, "Metric", env_idx=env_idx
                )

    def update(self, paused: bool) -> None:
        """Record the terms of the environment in view unless `paused`; refresh the plots a few
        times per second."""
        if not paused:
            env_idx = self.scene.env_idx
            rewards = list(self.env.reward_manager.get_active_iterable_terms(env_idx))
            for panel in (self.reward_bar_panel, self.reward_plotter):
                if panel is not None:
                    panel.add(rewards)
            if self.metrics_plotter is not None:
                terms = self.env.metrics_manager.get_active_iterable_terms(env_idx)
                self.metrics_plotter.add(terms)
        now = time.perf_counter()
        if now >= self._next_refresh:
            self._next_refresh = now + _REFRESH_PERIOD_S
            for panel in self._panels:
                panel.refresh()

    def on_env_switch(self) -> None:
        """Clear the plots and switch them to the environment now in view."""
        for plotter in (self.reward_plotter, self.metrics_plotter):
            if plotter is not None:
                plotter.update_env_idx(self.scene.env_idx)
        self.clear_histories()

    def clear_histories(self) -> None:
        """Clear the recorded values."""
        for panel in self._panels:
            panel.clear_histories()

    def cleanup(self) -> None:
        """Remove the panels from the page."""
        for panel in self._panels:
            panel.cleanup()
        self.reward_bar_panel = self.reward_plotter = self.metrics_plotter = None

    def _has_weight(self, name: str) -> bool:
        # Weights may change during training.
        return self.env.reward_manager.get_term_cfg(name).weight != 0.0

    @property
    def _panels(self) -> list[RewardBarPanel | ViserTermPlotter]:
        panels = (self.reward_bar_panel, self.reward_plotter, self.metrics_plotter)
        return [panel for panel in panels if panel is not None]


@dataclass
class ViserCameraOverlays:
    """Images and frustums of all camera sensors."""

    server: viser.ViserServer
    env: Any
    """Unwrapped environment."""
    mj_model: mujoco.MjModel
    camera_viewers: list[ViserCameraViewer] | None = None
    request_redraw: Callable[[], None] | None = None
    """Called when a control changes."""
    _folder: viser.GuiFolderHandle | None = field(default=None, init=False, repr=False)

    @property
    def has_cameras(self) -> bool:
        """True if the environment has a camera sensor."""
        return bool(self.camera_viewers)

    def setup_controls(self) -> None:
        """Add a folder with one viewer per camera sensor to the current GUI container."""
        sensors = [s for s in self.env.scene.sensors.values() if isinstance(s, CameraSensor)]
        self.camera_viewers = []
        if not sensors:
            return
        self._folder = self.server.gui.add_folder("Camera Feeds")
        with self._folder:
            self.camera_viewers = [
                ViserCameraViewer(
                    self.server,
                    sensor,
                    self.mj_model,
                    sim_model=self.env.sim.model,
                    request_redraw=self.request_redraw,
                )
                for sensor in sensors
            ]

    def update(self, sim_data: Any, env_idx: int, scene_offset: Any) -> None:
        """Show the latest images of environment `env_idx`."""
        for viewer in self.camera_viewers or ():
            viewer.update(sim_data, env_idx, scene_offset)

    def cleanup(self) -> None:
        """Remove the images and frustums from the page."""
        for viewer in self.camera_viewers or ():
            viewer.cleanup()
        self.camera_viewers = None
        if self._folder is not None:
            self._folder.remove()
            self._folder = None


@dataclass
class ViserDebugOverlays:
    """Debug drawings of the environment."""

    env: Any
    """Unwrapped environment."""
    scene: MjlabViserScene

    def queue(self) -> None:
        """Let the environment draw; the next scene update shows the drawings."""
        if self.scene.debug_visualization_enabled:
            self.scene.clear()
            self.env.update_visualizers(self.scene)

    def on_env_switch(self) -> None:
        """Remove the drawings of the previous environment."""
        self.scene.clear_debug_all()


@dataclass
class ViserContactOverlays:
    """Contact points and forces of the environment in view."""

    scene: MjlabViserScene

    def is_enabled(self) -> bool:
        """Return True if contact points or forces are shown."""
        return bool(self.scene.show_contact_points or self.scene.show_contact_forces)

    def on_env_switch(self) -> None:
        """Request a redraw with the contacts of the environment now in view."""
        if self.is_enabled():
            self.scene.request_update()
