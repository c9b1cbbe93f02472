"""The browser viewer: a page, served from this machine, that shows and controls a running policy."""

from __future__ import annotations

import enum
import logging
import time
from typing import TYPE_CHECKING, Any

import torch
import viser

from mjlab.viewer.base import BaseViewer, VerbosityLevel, ViewerAction
from mjlab.viewer.camera import resolve_camera
from mjlab.viewer.page_server import DEFAULT_HOST as DEFAULT_HOST
from mjlab.viewer.page_server import DEFAULT_PORT as DEFAULT_PORT
from mjlab.viewer.page_server import page_url, serve_page
from mjlab.viewer.protocols import forget
from mjlab.viewer.viser.checkpoints import CheckpointManager as CheckpointManager
from mjlab.viewer.viser.checkpoints import CheckpointPanel
from mjlab.viewer.viser.checkpoints import format_time_ago as format_time_ago
from mjlab.viewer.viser.controls import SimulationControls
from mjlab.viewer.viser.overlays import (
    ViserCameraOverlays,
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)
from mjlab.viewer.viser.scene import MjlabViserScene

if TYPE_CHECKING:
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol

log = logging.getLogger(__name__)

_PANEL_PERIOD_S = 0.2


class UpdateReason(enum.Enum):
    """Reason why the scene must be drawn again."""

    ACTION = enum.auto()
    """The environment was stepped or reset."""
    ENV_SWITCH = enum.auto()
    """Another environment is in view."""
    SCENE_REQUEST = enum.auto()
    """A control of the page was changed."""


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
        checkpoint_manager: CheckpointManager | None = None,
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
            checkpoint_manager: Checkpoints to choose from. None: no such tab.
            host: Address to serve on; `0.0.0.0` serves the whole network.
            port: Port to serve on; the next free one where it is taken.

        Raises:
            ValueError: this machine does not have the address `host`.
        """
        super().__init__(env, policy, frame_rate, verbosity)
        self._server = viser_server or serve_page(host, port)
        self._checkpoint_manager = checkpoint_manager
        self._closed = False
        self._scene: MjlabViserScene | None = None
        self._controls: SimulationControls | None = None
        self._term_overlays: ViserTermOverlays | None = None
        self._camera_overlays: ViserCameraOverlays | None = None
        self._debug_overlays: ViserDebugOverlays | None = None
        self._contact_overlays: ViserContactOverlays | None = None
        self._checkpoint_panel: CheckpointPanel | None = None
        self._shown_env = 0
        self._next_scene = self._next_panels = 0.0
        # Only ever changed in place: threads of the server add to it.
        self._update_reasons = {UpdateReason.ACTION}

    @property
    def server(self) -> viser.ViserServer:
        """The page's server."""
        return self._server

    @property
    def url(self) -> str:
        """Where to point a browser on this machine."""
        return page_url(self._server)

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
        model = env.sim.mj_model
        scene = self._scene = MjlabViserScene(
            self._server,
            model,
            env.num_envs,
            env.sim.model,
            env.sim.expanded_fields,
            view=resolve_camera(cfg, model, env.scene.entities),
            geom_group=cfg.geom_group,
            site_group=cfg.site_group,
        )
        scene.set_refresh_handler(lambda: self._update_reasons.add(UpdateReason.SCENE_REQUEST))
        scene.env_idx = self._shown_env = min(max(cfg.env_idx, 0), env.num_envs - 1)
        self._term_overlays = ViserTermOverlays(
            self._server, env, scene, float(env.step_dt), cfg.reward_bar_max_terms
        )
        self._camera_overlays = ViserCameraOverlays(
            self._server, env, model, request_redraw=scene.request_update
        )
        self._debug_overlays = ViserDebugOverlays(env, scene)
        self._contact_overlays = ViserContactOverlays(scene)
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
        self._follow_env_switch()
        if self._update_reasons and now >= self._next_scene:
            self._next_scene = now + self.scene_period
            # Requests from here on may come too late for this drawing, and cause another.
            self._update_reasons.clear()
            self._draw_scene()
        if self._term_overlays is not None:
            self._term_overlays.update(paused=True)
        if self._controls is not None and now >= self._next_panels:
            self._next_panels = now + _PANEL_PERIOD_S
            self._controls.show_status(self.get_status())

    def after_env_step(self) -> None:
        self._update_reasons.add(UpdateReason.ACTION)
        self._follow_env_switch()
        if self._term_overlays is not None:
            self._term_overlays.update(paused=False)

    def after_reset(self) -> None:
        self._update_reasons.add(UpdateReason.ACTION)
        if self._term_overlays is not None:
            self._term_overlays.clear_histories()

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
        """Have the engine provide what the scene reads."""
        sim = self.env.unwrapped.sim
        for name in ("xpos", "xmat", "mocap_pos", "mocap_quat"):
            if not name.startswith("mocap") or sim.mj_model.nmocap > 0:
                getattr(sim.data, name)

    def _create_gui(self) -> None:
        gui, scene = self._server.gui, self.scene
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Controls", icon=viser.Icon.SETTINGS):
            self.add_first_panels()
            self._controls = SimulationControls(self._server, self.request_action)
            self._add_command_panels()
            with gui.add_folder("Scene"):
                scene.create_scene_gui(debug_viz_extra_gui=self._add_debug_vis_switches)
            if self._camera_overlays is not None:
                self._camera_overlays.setup_controls()
        with tabs.add_tab("Visualization", icon=viser.Icon.EYE):
            scene.create_overlay_gui()
        if self._term_overlays is not None:
            self._term_overlays.setup_tabs(tabs)
        scene.create_groups_gui(tabs)
        if self._checkpoint_manager is not None:
            with tabs.add_tab("Checkpoints", icon=viser.Icon.FOLDER):
                self._checkpoint_panel = CheckpointPanel(
                    self._server,
                    self._checkpoint_manager,
                    lambda name: self.request_action("fetch_checkpoint", name),
                )

    def _add_command_panels(self) -> None:
        commands = self.env.unwrapped.command_manager
        if not getattr(commands, "active_terms", ()):
            return
        with self._server.gui.add_folder("Commands") as folder:
            commands.create_gui(
                self._server,
                lambda: self.scene.env_idx,
                self.scene.request_update,
                self.request_action,
            )
        if not folder._children:
            folder.remove()

    def _add_debug_vis_switches(self) -> None:
        env = self.env.unwrapped
        for part in (*env.manager_visualizers.values(), env.sensor_visualizers):
            part.create_debug_vis_gui(self._server, self.scene.request_update)

    def _draw_scene(self) -> None:
        env, scene = self.env.unwrapped, self.scene
        if self._debug_overlays is not None:
            self._debug_overlays.queue()
        scene.update(env.sim, self._shown_env)
        if self._camera_overlays is not None and self._camera_overlays.has_cameras:
            self._camera_overlays.update(env.sim.data, self._shown_env, scene.offset)

    def _follow_env_switch(self) -> None:
        """Start plots and drawings over if the page selected another environment."""
        env_idx = self.scene.env_idx
        if self._shown_env == env_idx:
            return
        self._shown_env = env_idx
        for overlays in (self._term_overlays, self._debug_overlays, self._contact_overlays):
            if overlays is not None:
                overlays.on_env_switch()
        self._update_reasons.add(UpdateReason.ENV_SWITCH)

    def _load_checkpoint(self, name: str) -> None:
        """Play on with another policy; one that cannot be loaded leaves the present one alone."""
        panel = self._checkpoint_panel
        if self._checkpoint_manager is None or panel is None:
            return
        try:
            policy = self._checkpoint_manager.load_checkpoint(name)
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
                env.sim.forward(ids)
                env.sim.sense()
                # What the reset observed is of the state before.
                env.observation_manager.reset(ids)
                env.obs_buf = env.observation_manager.compute(update_history=True, env_ids=ids)
            forget(self.policy, torch.zeros(env.num_envs, device=env.device).index_fill_(0, ids, 1))
        self.after_reset()
