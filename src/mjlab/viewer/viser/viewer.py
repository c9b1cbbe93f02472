"""The browser viewer: a page, served from this machine, that shows and controls a running policy."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

import torch
import viser

from mjlab.sensor import CameraSensor
from mjlab.viewer.base import BaseViewer, VerbosityLevel, ViewerAction
from mjlab.viewer.camera import resolve_camera
from mjlab.viewer.history import TermHistory
from mjlab.viewer.model_sync import host_model
from mjlab.viewer.viser.camera_feeds import CameraFeeds
from mjlab.viewer.viser.checkpoints import CheckpointPanel
from mjlab.viewer.viser.controls import SimulationControls
from mjlab.viewer.viser.reward_bars import RewardBarPanel
from mjlab.viewer.viser.scene import MjlabViserScene
from mjlab.viewer.viser.term_plotter import PLOT_POINTS, ViserTermPlotter

if TYPE_CHECKING:
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol
    from mjlab.viewer.viser.checkpoints import CheckpointSource

log = logging.getLogger(__name__)

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080

_PANEL_PERIOD_S = 0.2
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


class ViserPlayViewer(BaseViewer):
    """Shows all environments in a web page, with controls, rewards, metrics and checkpoints.

    The page is served to this machine only, unless `host` says otherwise: whoever can open it can
    control the run. Everything that touches the environment happens in the thread of `run`.
    """

    # Wall time from one drawing of the scene to the next, in seconds.
    scene_period = 1.0 / 30.0

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        frame_rate: float = 60.0,
        verbosity: int = VerbosityLevel.SILENT,
        viser_server: viser.ViserServer | None = None,
        checkpoints: CheckpointSource | None = None,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
    ) -> None:
        """Start serving; `url` says where. The page fills when `run` begins.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions.
            frame_rate: Display updates per second of wall time.
            verbosity: How much to log, a `VerbosityLevel`.
            viser_server: A server to use instead of starting one at `host` and `port`.
            checkpoints: Where other checkpoints can be chosen from, if anywhere.
            host: Address to serve on; `0.0.0.0` serves the whole network.
            port: Port to serve on; the next free one where it is taken.
        """
        super().__init__(env, policy, frame_rate, verbosity)
        if viser_server is None and host not in _LOOPBACK:
            log.warning(
                "The viewer is served on %s: everyone who can reach this machine can control it.",
                host,
            )
        self._server = viser_server or viser.ViserServer(host=host, port=port, verbose=False)
        self._checkpoints = checkpoints
        self._closed = False
        self._rewards = TermHistory(PLOT_POINTS)
        self._metrics = TermHistory(PLOT_POINTS)
        self._history_env: int | None = None
        self._scene: MjlabViserScene | None = None
        self._controls: SimulationControls | None = None
        self._camera_feeds: CameraFeeds | None = None
        self._reward_bars: RewardBarPanel | None = None
        self._plots: list[tuple[ViserTermPlotter, TermHistory]] = []
        self._checkpoint_panel: CheckpointPanel | None = None
        self._next_scene = self._next_panels = 0.0
        self._dirty = True

    @property
    def server(self) -> viser.ViserServer:
        """The page's server."""
        return self._server

    @property
    def url(self) -> str:
        """Where to point a browser on this machine."""
        host = self._server.get_host()
        shown = "localhost" if host in ("0.0.0.0", "::", *_LOOPBACK) else host
        return f"http://{shown}:{self._server.get_port()}"

    @property
    def scene(self) -> MjlabViserScene:
        """The 3-D scene.

        Raises:
            RuntimeError: `setup` has not been called.
        """
        if self._scene is None:
            raise RuntimeError(
                "The viewer's scene does not exist yet; call setup() or run() first."
            )
        return self._scene

    def setup(self) -> None:
        env, cfg = self.env.unwrapped, self.cfg
        model = host_model(env.sim.mj_model)
        self._scene = MjlabViserScene(
            self._server,
            model,
            env.num_envs,
            view=resolve_camera(cfg, model, env.scene.entities),
            geom_group=cfg.geom_group,
            site_group=cfg.site_group,
        )
        self._scene.env_idx = min(max(cfg.env_idx, 0), env.num_envs - 1)
        self._bind_drawn_fields()
        self._create_gui()
        log.debug("The viewer is at %s", self.url)

    def is_running(self) -> bool:
        return not self._closed

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._server.stop()

    def add_first_panels(self) -> None:
        """Add to the top of the Controls tab; for subclasses, nothing by default."""

    def sync_viewer_to_env(self) -> None:
        # Commands' own panels write into their terms; nothing else goes this way.
        pass

    def sync_env_to_viewer(self) -> None:
        now = time.perf_counter()
        changed = self._dirty or self.scene.redraw_requested
        if changed and now >= self._next_scene:
            self._next_scene = now + self.scene_period
            self._dirty = False
            self._forget_history_of_other_env()
            sim = self.env.unwrapped.sim
            self.scene.draw(sim, self.env.unwrapped.update_visualizers)
            if self._camera_feeds is not None:
                self._camera_feeds.show(sim, self.scene.env_idx, self.scene.offset)
        if now >= self._next_panels:
            self._next_panels = now + _PANEL_PERIOD_S
            self._update_panels()

    def after_env_step(self) -> None:
        self._dirty = True
        self._forget_history_of_other_env()
        env, env_idx = self.env.unwrapped, self.scene.env_idx
        self._rewards.add(env.reward_manager.get_active_iterable_terms(env_idx))
        self._metrics.add(env.metrics_manager.get_active_iterable_terms(env_idx))

    def after_reset(self) -> None:
        self._dirty = True
        self._clear_history()

    def on_paused(self, paused: bool) -> None:
        self.env.unwrapped.command_manager.on_viewer_pause(paused)
        if self._controls is not None:
            self._controls.show_paused(paused)

    def handle_action(self, action: ViewerAction, payload: Any) -> bool:
        if action is ViewerAction.FETCH_CHECKPOINT:
            self._load_checkpoint(str(payload))
            return True
        # What a command's panel sends to start from the state that it shows.
        if isinstance(payload, dict) and payload.get("type") == "gui_reset":
            self._gui_reset(all_envs=bool(payload.get("all_envs", True)))
            return True
        return False

    def _bind_drawn_fields(self) -> None:
        """Have the engine provide what the scene reads; it is zero until the next forward."""
        sim = self.env.unwrapped.sim
        for name in ("xpos", "xmat", "mocap_pos", "mocap_quat"):
            if not name.startswith("mocap") or sim.mj_model.nmocap > 0:
                getattr(sim.data, name)
        sim.forward()

    def _create_gui(self) -> None:
        env, gui, scene = self.env.unwrapped, self._server.gui, self.scene
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Controls", icon=viser.Icon.SETTINGS):
            self.add_first_panels()
            self._controls = SimulationControls(self._server, self.request_action)
            self._add_command_panels()
            with gui.add_folder("Scene"):
                scene.create_scene_gui()
                self._add_debug_vis_panel()
            self._add_camera_feeds()
        with tabs.add_tab("Visualization", icon=viser.Icon.EYE):
            scene.create_overlay_gui()
        with tabs.add_tab("Rewards", icon=viser.Icon.CHART_BAR):
            names = list(env.reward_manager.active_terms)
            self._reward_bars = RewardBarPanel(self._server, names, self.cfg.reward_bar_max_terms)
            self._plots.append((ViserTermPlotter(self._server, names), self._rewards))
        metrics = list(env.metrics_manager.active_terms) if self._has_metrics() else []
        if metrics:
            with tabs.add_tab("Metrics", icon=viser.Icon.CHART_LINE):
                self._plots.append((ViserTermPlotter(self._server, metrics), self._metrics))
        with tabs.add_tab("Groups", icon=viser.Icon.LAYERS_INTERSECT):
            scene.create_groups_gui()
        if self._checkpoints is not None:
            with tabs.add_tab("Checkpoints", icon=viser.Icon.FOLDER):
                self._checkpoint_panel = CheckpointPanel(
                    self._server,
                    self._checkpoints,
                    lambda name: self.request_action("fetch_checkpoint", name),
                )

    def _add_camera_feeds(self) -> None:
        env = self.env.unwrapped
        cameras = {
            name: sensor
            for name, sensor in getattr(env.scene, "sensors", {}).items()
            if isinstance(sensor, CameraSensor)
        }
        if cameras:
            self._camera_feeds = CameraFeeds(
                self._server, cameras, env.sim.mj_model, self.scene.request_redraw
            )

    def _has_metrics(self) -> bool:
        return bool(getattr(self.env.unwrapped.metrics_manager, "active_terms", ()))

    def _add_command_panels(self) -> None:
        commands = self.env.unwrapped.command_manager
        if not getattr(commands, "active_terms", ()):
            return
        with self._server.gui.add_folder("Commands") as folder:
            commands.create_gui(
                self._server,
                lambda: self.scene.env_idx,
                self.scene.request_redraw,
                self.request_action,
            )
        if not folder._children:
            folder.remove()

    def _add_debug_vis_panel(self) -> None:
        env, gui, scene = self.env.unwrapped, self._server.gui, self.scene
        with gui.add_folder("Debug Viz"):
            enabled = gui.add_checkbox("Enabled", scene.debug_enabled)
            all_envs = gui.add_checkbox("All envs", scene.show_all_debug, visible=env.num_envs > 1)
            for part in (*env.manager_visualizers.values(), env.sensor_visualizers):
                part.create_debug_vis_gui(self._server, scene.request_redraw)

        @enabled.on_update
        def _(_: Any) -> None:
            scene.debug_enabled = enabled.value
            scene.request_redraw()

        @all_envs.on_update
        def _(_: Any) -> None:
            scene.show_all_debug = all_envs.value
            scene.request_redraw()

    def _update_panels(self) -> None:
        if self._controls is not None:
            self._controls.show_status(self.get_status())
        if self._reward_bars is not None:
            self._reward_bars.update(self._rewards)
        for plotter, history in self._plots:
            plotter.update(history)

    def _forget_history_of_other_env(self) -> None:
        if self._history_env != self.scene.env_idx:
            self._history_env = self.scene.env_idx
            self._clear_history()

    def _clear_history(self) -> None:
        self._rewards.clear()
        self._metrics.clear()

    def _load_checkpoint(self, name: str) -> None:
        """Play on with another policy; one that cannot be loaded leaves the present one alone."""
        panel = self._checkpoint_panel
        if self._checkpoints is None or panel is None:
            return
        try:
            policy = self._checkpoints.load(name)
        except Exception as error:
            log.exception("Cannot load the checkpoint %s.", name)
            panel.show_error(f"Cannot load {name}: {error}")
            return
        self.policy = policy
        self.reset_environment()
        panel.show_loaded(name)

    def _gui_reset(self, all_envs: bool) -> None:
        """Reset the selected or all environments into the state a command's panel asks for."""
        env = self.env.unwrapped
        ids = torch.arange(env.num_envs) if all_envs else torch.tensor([self.scene.env_idx])
        ids = ids.to(env.device)
        with torch.no_grad():
            env.reset(env_ids=ids)
            if env.command_manager.apply_gui_reset(ids):
                env.sim.forward()
                env.sim.sense()
                # What the reset observed is of the state before.
                env.observation_manager.reset(ids)
                env.obs_buf = env.observation_manager.compute(update_history=True, env_ids=ids)
        self.after_reset()
