"""Browser viewer: page that shows and controls a running policy.

`ViserPlayViewer` is the viewer. Its Controls tab has the status and buttons of
`SimulationControls`, its Checkpoints tab the `CheckpointPanel` of a `CheckpointManager`.
"""

from __future__ import annotations

import enum
import logging
import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import torch
import viser

from mjlab.utils.errors import WrongStateError
from mjlab.utils.os import files_in
from mjlab.utils.string import encodable, escaped
from mjlab.viewer import gamepad
from mjlab.viewer.base import BaseViewer, VerbosityLevel, ViewerAction, ViewerStatus, reset_policy
from mjlab.viewer.native.keys import BINDINGS, KEY_HELP, STEERING_HELP, Binding
from mjlab.viewer.page_proxy import PageServer
from mjlab.viewer.page_server import DEFAULT_HOST as DEFAULT_HOST
from mjlab.viewer.page_server import DEFAULT_PORT as DEFAULT_PORT
from mjlab.viewer.page_server import page_url, serve_page
from mjlab.viewer.viser.clip import ClipPanel
from mjlab.viewer.viser.look import set_theme
from mjlab.viewer.viser.overlays import (
    ViserCameraOverlays,
    ViserContactOverlays,
    ViserDebugOverlays,
    ViserTermOverlays,
)
from mjlab.viewer.viser.scene import MjlabViserScene, scene_of

if TYPE_CHECKING:
    from mjlab.viewer.base import EnvProtocol, PolicyProtocol
    from mjlab.viewer.debug_visualizer import Color


log = logging.getLogger(__name__)

# Wall time between updates of the status.
_PANEL_PERIOD_S = 0.2
_SPEED_ACTIONS = {"Slower": "speed_down", "1x": "reset_speed", "Faster": "speed_up"}
_NONE_FOUND = "(none)"


@dataclass
class CheckpointManager:
    """Checkpoints of a run that the viewer can play."""

    current_name: str
    """Name of the checkpoint in use."""
    fetch_available: Callable[[], list[tuple[str, str]]]
    """Function that lists (name, age) of checkpoints, oldest first. Called in a thread of the
    server."""
    load_checkpoint: Callable[[str], PolicyProtocol]
    """Function that returns the policy of a checkpoint by name. Called in the viewer's thread."""
    run_name: str | None = None
    """Name of the run. None: checkpoints are local files."""
    run_url: str | None = None
    """URL of the run's page."""
    run_status: str | None = None
    """Status of the run."""


class UpdateReason(enum.Enum):
    """Reason to redraw the scene."""

    ACTION = enum.auto()
    """Step or reset of the environment."""
    ENV_SWITCH = enum.auto()
    """Switch to another environment."""
    SCENE_REQUEST = enum.auto()
    """Change of a control on the page."""


class ViserPlayViewer(BaseViewer):
    """Web page with all environments, controls, rewards, metrics and checkpoints.

    By default the page is served to this machine only, because all visitors can control the run.
    Only the thread of `run` accesses the environment.
    """

    # Minimum wall time between scene updates (s).
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
        """Start serving at `url`; `run` fills the page.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions.
            frame_rate: Display updates per second of wall time.
            verbosity: Log verbosity, a `VerbosityLevel`.
            viser_server: Server to use instead of starting one at `host` and `port`.
            checkpoint_manager: Selectable checkpoints. None: no Checkpoints tab.
            host: Address to serve on; `0.0.0.0` serves the whole network.
            port: Port to serve on; if in use, the next free one.

        Raises:
            ValueError: `host` is not an address of this machine, or `port` not in [1, 65535].
        """
        super().__init__(env, policy, frame_rate, verbosity)
        self._server = viser_server or serve_page(host, port)
        self._checkpoint_manager = checkpoint_manager
        self._closed = False
        self._scene: MjlabViserScene | None = None
        self._controls: SimulationControls | None = None
        self._term_overlays: ViserTermOverlays | None = None
        self._clip_panel: ClipPanel | None = None
        self._checkpoint_panel: CheckpointPanel | None = None
        self._shown_env = 0
        self._next_scene = self._next_panels = 0.0
        # Modify in place only: threads of the server add reasons.
        self._update_reasons = {UpdateReason.ACTION}

    @property
    def server(self) -> viser.ViserServer:
        """The page's server."""
        return self._server

    @property
    def url(self) -> str:
        """URL of the page for a browser on this machine."""
        return page_url(self._server)

    @property
    def scene(self) -> MjlabViserScene:
        """3-D scene.

        Raises:
            RuntimeError: `setup` has not been called.
        """
        if self._scene is None:
            raise WrongStateError("The viewer's scene is not set up; call setup() or run() first.")
        return self._scene

    def setup(self) -> None:
        env, cfg = self.env.unwrapped, self.cfg
        model = env.sim.mj_model
        scene = self._scene = scene_of(env, self._server)
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
        self._create_gui()

    def is_running(self) -> bool:
        return not self._closed

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            if self._clip_panel is not None:
                self._clip_panel.close()
            self._server.stop()

    def add_first_panels(self) -> None:
        """Add panels to the top of the Controls tab. For subclasses; the default adds none."""

    def sync_viewer_to_env(self) -> None:
        # Command panels write into their terms; the page has no other input.
        pass

    def sync_env_to_viewer(self) -> None:
        now = time.perf_counter()
        self._follow_env_switch()
        if self._update_reasons and now >= self._next_scene:
            self._next_scene = now + self.scene_period
            # Clear before drawing: later requests may miss this update and must cause another.
            self._update_reasons.clear()
            env, scene = self.env.unwrapped, self.scene
            self._debug_overlays.queue()
            scene.update(env.sim, self._shown_env)
            self._camera_overlays.update(env.sim.data, self._shown_env, scene.offset)
            if self._clip_panel is not None:
                self._clip_panel.update()
        if self._term_overlays is not None:
            self._term_overlays.update(paused=True)
        if self._controls is not None and now >= self._next_panels:
            self._next_panels = now + _PANEL_PERIOD_S
            self._controls.show_status(self.get_status())
            self._controls.show_legend(self.scene.legend)

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
            panel = self._checkpoint_panel
            policy = None if panel is None else panel.load(str(payload))
            if policy is not None:
                self.policy = policy
                self.reset_environment()
            return True
        scene = self.scene
        if action in (ViewerAction.PREV_ENV, ViewerAction.NEXT_ENV):
            scene.select_env(scene.env_idx + (1 if action is ViewerAction.NEXT_ENV else -1))
            return True
        if action is ViewerAction.TOGGLE_DEBUG_VIS:
            scene.toggle("debug_visualization_enabled")
            return True
        if action is ViewerAction.TOGGLE_SHOW_ALL_ENVS:
            scene.toggle("show_all_envs")
            return True
        # Command panels send gui_reset to start from the state that they show.
        if isinstance(payload, dict) and payload.get("type") == "gui_reset":
            self._gui_reset(all_envs=bool(payload.get("all_envs", True)))
            return True
        return False

    def env_in_view(self) -> int:
        return self.scene.env_idx

    def _create_gui(self) -> None:
        gui, scene, env = self._server.gui, self.scene, self.env.unwrapped

        def add_debug_vis_switches() -> None:
            for part in (*env.manager_visualizers.values(), env.sensor_visualizers):
                part.create_debug_vis_gui(self._server, scene.request_update)

        set_theme(self._server)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Controls", icon=viser.Icon.SETTINGS):
            self.add_first_panels()
            self._controls = SimulationControls(self._server, self.request_action)
            self._clip_panel = ClipPanel(scene, env, fps=1.0 / max(self.scene_period, env.step_dt))
            with gui.add_folder("Commands") as folder:
                env.command_manager.create_gui(
                    self._server, lambda: scene.env_idx, scene.request_update, self.request_action
                )
            if not folder._children:
                folder.remove()
            steerable = env.command_manager.steerable
            has_gamepad = steerable and isinstance(self._server, PageServer)
            if has_gamepad:
                self._server.on_gamepad = lambda sticks: self.request_action("steer", sticks)
            add_keys(self._server, steerable, has_gamepad, self.request_action)
            with gui.add_folder("Scene"):
                scene.create_scene_gui(debug_viz_extra_gui=add_debug_vis_switches)
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

    def _follow_env_switch(self) -> None:
        """Restart plots and drawings if the page selected another environment."""
        env_idx = self.scene.env_idx
        if self._shown_env == env_idx:
            return
        self._shown_env = env_idx
        for overlays in (self._term_overlays, self._debug_overlays, self._contact_overlays):
            if overlays is not None:
                overlays.on_env_switch()
        self._update_reasons.add(UpdateReason.ENV_SWITCH)

    def _gui_reset(self, all_envs: bool) -> None:
        """Reset the selected or all environments to the state of a command panel."""
        env = self.env.unwrapped
        ids = torch.arange(env.num_envs) if all_envs else torch.tensor([self.scene.env_idx])
        ids = ids.to(env.device)
        with torch.no_grad():
            env.reset(env_ids=ids)
            if env.command_manager.apply_gui_reset(ids):
                env.sim.forward(ids)
                env.sim.sense()
                # `reset` observed the state before the panel set its own.
                env.observation_manager.reset(ids)
                env.obs_buf = env.observation_manager.compute(update_history=True, env_ids=ids)
            dones = torch.zeros(env.num_envs, device=env.device).index_fill_(0, ids, 1)
            reset_policy(self.policy, dones)
        self.after_reset()


def add_keys(
    server: viser.ViserServer,
    steerable: bool,
    has_gamepad: bool,
    request_action: Callable[..., None],
) -> None:
    """Bind the keys of the page, and list them in a folder.

    Args:
        server: The page's server.
        steerable: Bind and list the keys that steer the robot.
        has_gamepad: Link to the page that reads a gamepad.
        request_action: Queues a viewer action by name, with a payload, for the main thread.
    """
    for binding in BINDINGS:
        if binding.hotkey is None or (binding.action is ViewerAction.STEER and not steerable):
            continue
        command = server.gui.add_command(binding.label, hotkey=binding.hotkey)

        @command.on_trigger
        def _(_event: Any, binding: Binding = binding) -> None:
            request_action(binding.action.value, binding.payload)

    rows = "".join(
        f"<div><strong>{keys}:</strong> {meaning}</div>"
        for keys, meaning in (*(STEERING_HELP if steerable else ()), *KEY_HELP)
    )
    if has_gamepad:
        rows += f'<div><a href="{gamepad.PATH}" target="_blank">Page with gamepad</a></div>'
    with server.gui.add_folder("Keys", expand_by_default=False):
        server.gui.add_html(f'<div style="padding:0 1em;font-size:0.85em">{rows}</div>')


class SimulationControls:
    """Info and Simulation folders of the Controls tab."""

    def __init__(self, server: viser.ViserServer, request_action: Callable[..., None]) -> None:
        """Add the controls to the current GUI container.

        Args:
            server: The page's server.
            request_action: Queues a viewer action by name for the main thread.
        """
        gui = server.gui
        with gui.add_folder("Info"):
            self._status = gui.add_html("")
            self._legend = gui.add_html("")
        with gui.add_folder("Simulation"):
            self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
            self._step = gui.add_button(
                "Step",
                icon=viser.Icon.PLAYER_TRACK_NEXT,
                disabled=True,
                hint="One environment step, while paused.",
            )
            reset = gui.add_button("Reset Environment", icon=viser.Icon.REFRESH)
            speed = gui.add_button_group("Speed", list(_SPEED_ACTIONS))
        self._pause.on_click(lambda _: request_action("toggle_pause"))
        self._step.on_click(lambda _: request_action("single_step"))
        reset.on_click(lambda _: request_action("reset"))
        speed.on_click(lambda event: request_action(_SPEED_ACTIONS[event.target.value]))

    def show_paused(self, paused: bool) -> None:
        """Update the labels of the buttons."""
        self._pause.label = "Play" if paused else "Pause"
        self._pause.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE
        self._step.disabled = not paused

    def show_status(self, status: ViewerStatus) -> None:
        """Update the displayed status. The server sends only changes."""
        self._status.content = status_html(status)

    def show_legend(self, legend: Mapping[str, Color]) -> None:
        """Update the displayed legend."""
        self._legend.content = legend_html(legend)


def legend_html(legend: Mapping[str, Color]) -> str:
    """Return the colors of the drawings and their meanings as HTML."""
    # Lines break at the spaces between entries.
    squares = " ".join(
        f'<span style="margin-right:1em;white-space:nowrap"><span style="color:rgba'
        f'({",".join(str(round(255 * part)) for part in color[:3])},{color[3]:.3g})">\u25a0</span> '
        f"{escaped(meaning)}</span>"
        for meaning, color in legend.items()
    )
    return f'<div style="padding:0 1em;font-size:0.85em">{squares}</div>' if legend else ""


def status_html(status: ViewerStatus) -> str:
    """Return the status as an HTML table."""
    state = "Paused" if status.paused else "Running"
    if status.capped and not status.paused:
        state += ' <span style="color:#e03131">CAPPED</span>'
    actual = "—" if status.actual_realtime <= 0 else f"{status.actual_realtime:.2f}x"
    rows = [
        ("Status", state),
        ("Steps", f"{status.step_count:,}"),
        ("Speed", status.speed_label),
        ("Real time", f"{actual} of {status.target_realtime:g}x ({status.smoothed_fps:.0f} FPS)"),
    ]
    if status.last_error is not None:
        error = escaped(status.last_error)
        rows.append(("Error", f'<span style="color:#e03131">{error}</span>'))
    lines = "".join(f"<div><strong>{name}:</strong> {value}</div>" for name, value in rows)
    return f'<div style="padding:0.25em 1em;font-size:0.85em;line-height:1.5">{lines}</div>'


class CheckpointPanel:
    """Checkpoint list with Sync and Use Latest. Errors are shown here, not raised."""

    def __init__(
        self,
        server: viser.ViserServer,
        manager: CheckpointManager,
        request_load: Callable[[str], None],
    ):
        """Add the panel to the current GUI container and list the available checkpoints.

        Args:
            server: The page's server.
            manager: Checkpoints to list and load.
            request_load: Requests the main thread to load a checkpoint by name.
        """
        self._manager = manager
        self._request_load = request_load
        self._labels: dict[str, str] = {}
        # Suppresses the list's callback, because setting the value invokes it.
        self._silent = threading.local()
        gui = server.gui
        self._about = gui.add_markdown("")
        self._choice = gui.add_dropdown("Checkpoint", [_NONE_FOUND])
        self._message = gui.add_html("")
        latest = gui.add_button("Use Latest", icon=viser.Icon.PLAYER_TRACK_NEXT)
        sync = gui.add_button("Sync", icon=viser.Icon.REFRESH, hint="Look for new checkpoints.")
        self._choice.on_update(self._on_choice)
        latest.on_click(lambda _: self.load_latest())
        sync.on_click(lambda _: self.refresh())
        self.refresh()
        self.select(manager.current_name)

    def refresh(self) -> None:
        """Refresh the list and keep the selection if it still exists."""
        try:
            checkpoints = self._manager.fetch_available()
        except Exception as error:
            self.show_error(f"Cannot list checkpoints: {error}")
            return
        self._about.content = "**Local checkpoints**"
        run, url, state = self._manager.run_name, self._manager.run_url, self._manager.run_status
        if run is not None:
            name = escaped(run)
            # Browsers run the code in other schemes, such as `javascript:`.
            if url is not None and url.startswith(("https://", "http://")):
                name = f"[{name}]({quote(url, safe=':/?#&=%~@+,;', errors='replace')})"
            status = "" if state is None else f" ({escaped(state)})"
            self._about.content = f"**Run:** {name}{status}"
        chosen = self._labels.get(self._choice.value)
        # Newest first: users usually want the latest checkpoint.
        labels = {f"{name} ({age})" if age else name: name for name, age in checkpoints[::-1]}
        self._labels = {encodable(label): name for label, name in labels.items()}
        self._set_silently("options", list(self._labels) or [_NONE_FOUND])
        self.select(chosen or self._manager.current_name)
        self._show(f"{len(checkpoints)} found.")

    def select(self, name: str) -> None:
        """Select `name` without loading it."""
        for label, candidate in self._labels.items():
            if candidate == name:
                self._set_silently("value", label)

    def load(self, name: str) -> PolicyProtocol | None:
        """Return the policy of a checkpoint and select its name. None: loading failed."""
        try:
            policy = self._manager.load_checkpoint(name)
        except Exception as error:
            self.show_error(f"Cannot load {name}: {error}")
            return None
        self._manager.current_name = name
        self.select(name)
        self._show(f"Loaded {name}.")
        return policy

    def show_error(self, message: str) -> None:
        """Show an error message, and log it."""
        log.error("%s", encodable(message))
        self._show(message, color="#e03131")

    def load_latest(self) -> None:
        """Refresh the list and load the newest checkpoint."""
        self.refresh()
        if self._labels:
            self._request_load(next(iter(self._labels.values())))

    def _show(self, message: str, color: str = "inherit") -> None:
        self._message.content = (
            f'<div style="padding:0 1em;font-size:0.85em;color:{color}">{escaped(message)}</div>'
        )

    def _set_silently(self, attribute: str, value: Any) -> None:
        self._silent.on = True
        try:
            setattr(self._choice, attribute, value)
        finally:
            self._silent.on = False

    def _on_choice(self, _: Any) -> None:
        name = self._labels.get(self._choice.value)
        if name is not None and not getattr(self._silent, "on", False):
            self._request_load(name)


def local_checkpoints(
    folder: Path, load_policy: Callable[[Path], PolicyProtocol], current: str = ""
) -> CheckpointManager:
    """Return a manager of the checkpoints (`*.pt`) in `folder`; `current` is the loaded one."""

    def fetch_available() -> list[tuple[str, str]]:
        # replay_*.pt files contain a replay buffer, not a policy.
        files = [path for path in files_in(folder, "*.pt") if not path.name.startswith("replay_")]
        files.sort(key=lambda path: checkpoint_number(path.name))
        now = time.time()
        return [(file.name, format_time_ago(int(now - file.stat().st_mtime))) for file in files]

    return CheckpointManager(
        current_name=current,
        fetch_available=fetch_available,
        load_checkpoint=lambda name: load_policy(folder / name),
        run_name=str(folder),
    )


def checkpoint_number(name: str) -> int:
    """Return the number after the first underscore of a checkpoint's name, or 0."""
    match = re.match(r"[^_]*_(\d+)", name)
    return int(match.group(1)) if match else 0


def format_time_ago(seconds: int) -> str:
    """Return a time span as `12s ago`, `5m ago`, `2h ago` or `3d ago`."""
    for unit, length in (("d", 86400), ("h", 3600), ("m", 60)):
        if seconds >= length:
            return f"{int(seconds // length)}{unit} ago"
    return f"{max(int(seconds), 0)}s ago"
