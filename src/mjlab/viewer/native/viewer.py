"""Native viewer: MuJoCo's window on one environment of a running policy.

The mouse pushes bodies (`MousePush`); reward terms can be plotted over the image.
"""

from __future__ import annotations

import logging
import math
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from mjlab.viewer.base import BaseViewer, TermHistory, VerbosityLevel, ViewerAction
from mjlab.viewer.camera import first_moving_body, nearest_envs, resolve_camera
from mjlab.viewer.model_sync import VIEWER_INERTIAL_FIELDS as VIEWER_INERTIAL_FIELDS
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS as VIEWER_MODEL_FIELDS
from mjlab.viewer.model_sync import (
    compute_poses,
    copy_state,
    host_model,
    sync_model_fields,
    to_numpy,
)
from mjlab.viewer.native.keys import BINDINGS, KEY_HELP, STEERING_HELP
from mjlab.viewer.native.visualizer import MujocoNativeDebugVisualizer, add_moving_geoms
from mjlab.viewer.offscreen_renderer import RenderingUnavailableError, move_sun, prepare_sun

if TYPE_CHECKING:
    import mujoco.viewer

    from mjlab.viewer.base import EnvProtocol, PolicyProtocol


log = logging.getLogger(__name__)

_MARKER_COLOR = (0.9, 0.1, 0.1, 0.9)
_CLOSING_TIMEOUT_S = 5.0
_BINDINGS = {binding.code: binding for binding in BINDINGS}


@dataclass
class PlotCfg:
    """Reward plots of the native viewer."""

    history: int = 300
    """Number of environment steps shown."""
    p_lo: float = 2.0
    """Percentile of the values at the lower end of the y-range."""
    p_hi: float = 98.0
    """Percentile of the values at the upper end of the y-range."""
    pad: float = 0.25
    """Padding of the y-range at both ends, as a fraction of its span."""
    min_span: float = 1e-6
    """Smallest span of the y-range that is padded."""
    init_yrange: tuple[float, float] = (-0.01, 0.01)
    """Y-range of a term without values, or with zeros only."""
    grid_size: tuple[int, int] = (3, 4)
    """Number of grid lines along x and y."""
    max_viewports: int = 12
    """Maximum number of plotted terms."""
    min_rows_per_col: int = 4
    """Minimum number of rows per column."""
    max_rows_per_col: int = 6
    """Maximum number of plots per column."""
    plot_strip_fraction: float = 1 / 3
    """Fraction of the window's width that all columns together take."""
    background_alpha: float = 0.5
    """Opacity of the plots' black background."""


class NativeMujocoViewer(BaseViewer):
    """Window with one environment, its nearest neighbors, rewards and debug drawings.

    Double-click selects a body, Ctrl-drag pushes or twists it. The window lists its keys, none of
    which MuJoCo's window uses. Derived quantities on display, e.g. contacts, come from a CPU
    forward pass even if the environment runs on a GPU.

    Attributes:
        mjm: Private copy of the model, with the values of the environment in view.
        mjd: State of the environment in view.
        env_idx: Environment in view.
    """

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        frame_rate: float = 60.0,
        key_callback: Callable[[int], None] | None = None,
        plot_cfg: PlotCfg | None = None,
        enable_perturbations: bool = True,
        verbosity: int = VerbosityLevel.SILENT,
    ) -> None:
        """Create the viewer; `run` (or `setup`) opens the window.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions.
            frame_rate: Displayed frames per second of wall time.
            key_callback: Called with every key (GLFW code), in the window's thread.
            plot_cfg: Size and range of the reward plots.
            enable_perturbations: Let the mouse push bodies.
            verbosity: Log verbosity, a `VerbosityLevel`.
        """
        super().__init__(env, policy, frame_rate, verbosity)
        self._user_key_callback = key_callback
        self._enable_perturbations = enable_perturbations
        unwrapped = env.unwrapped
        self.mjm = host_model(unwrapped.sim.mj_model)
        prepare_sun(self.mjm, self.cfg.distance)
        # Neighbors are posed in a separate model, so that the window's model changes only while
        # locked.
        self._extra_model = host_model(unwrapped.sim.mj_model)
        self.mjd = mujoco.MjData(self.mjm)
        self._extra_data = mujoco.MjData(self._extra_model)
        self._view = resolve_camera(self.cfg, self.mjm, unwrapped.scene.entities)
        if self._view.fovy is not None:
            self.mjm.vis.global_.fovy = self._view.fovy
        self._marked_body = (
            self._view.body_id if self._view.body_id is not None else first_moving_body(self.mjm)
        )
        self.env_idx = min(max(self.cfg.env_idx, 0), unwrapped.num_envs - 1)
        self._plot_cfg = plot_cfg if plot_cfg is not None else PlotCfg()
        self._rewards = TermHistory(self._plot_cfg.history)
        self._push = MousePush(self.mjm)
        self._show_plots = False
        self._show_debug_vis = True
        self._show_all_envs = False
        self._handle: mujoco.viewer.Handle | None = None
        self._window_threads: set[threading.Thread] = set()
        self._visualizer: MujocoNativeDebugVisualizer | None = None

    def setup(self) -> None:
        """Open the window.

        Raises:
            RenderingUnavailableError: No display found.
        """
        require_display()
        import mujoco.viewer

        self._load_selected()
        others = set(threading.enumerate())
        try:
            self._handle = mujoco.viewer.launch_passive(
                self.mjm,
                self.mjd,
                key_callback=self._on_key,
                show_left_ui=False,
                show_right_ui=False,
            )
        except Exception as error:
            raise RenderingUnavailableError(
                f"Cannot open MuJoCo's window: {error}; use the browser viewer (--viewer viser)."
            ) from error
        self._window_threads = set(threading.enumerate()) - others
        with self._handle.lock():
            self._configure_window(self._handle)

    def is_running(self) -> bool:
        return self._handle is not None and self._handle.is_running()

    def close(self) -> None:
        if self._handle is not None:
            self._push.release(self.env.unwrapped.sim)
            self._handle.close()
            self._handle = None
        # The window's thread draws a last frame after `close`. A program that exits meanwhile
        # unloads the graphics library in use, and crashes.
        for thread in self._window_threads:
            thread.join(timeout=_CLOSING_TIMEOUT_S)
        self._window_threads = set()

    def sync_env_to_viewer(self) -> None:
        handle = self._handle
        if handle is None or not handle.is_running():
            return
        with handle.lock():
            self._load_selected()
            self._update_debug_visualizers(handle)
            if self._view.body_id is not None and self._com_differs:
                handle.cam.lookat[:] = self._view.target(self.mjd.xpos)
            if self.env.unwrapped.num_envs > 1:
                self._draw_neighbors(handle.user_scn)
        handle.set_texts(self._overlay())
        if self._show_plots and handle.viewport is not None:
            handle.set_figures(reward_figures(self._rewards, handle.viewport, self._plot_cfg))
        handle.sync()

    def sync_viewer_to_env(self) -> None:
        handle = self._handle
        if handle is None or not self._enable_perturbations:
            return
        # Do not wait for the window's lock without a push.
        if handle.perturb.active or self._push.active:
            with handle.lock():
                self._push.apply(self.env.unwrapped.sim, self.env_idx, self.mjd, handle.perturb)

    def after_env_step(self) -> None:
        manager = self.env.unwrapped.reward_manager
        self._rewards.add(manager.get_active_iterable_terms(self.env_idx))

    def after_reset(self) -> None:
        self._rewards.clear()

    def on_paused(self, paused: bool) -> None:
        self.env.unwrapped.command_manager.on_viewer_pause(paused)

    def handle_action(self, action: ViewerAction, payload: Any) -> bool:
        if action in (ViewerAction.PREV_ENV, ViewerAction.NEXT_ENV):
            self.select_env(self.env_idx + (1 if action is ViewerAction.NEXT_ENV else -1))
        elif action is ViewerAction.TOGGLE_PLOTS:
            self._show_plots = not self._show_plots
            if not self._show_plots and self._handle is not None:
                self._handle.clear_figures()
        elif action is ViewerAction.TOGGLE_DEBUG_VIS:
            self._show_debug_vis = not self._show_debug_vis
        elif action is ViewerAction.TOGGLE_SHOW_ALL_ENVS:
            self._show_all_envs = not self._show_all_envs
        else:
            return False
        return True

    def env_in_view(self) -> int:
        return self.env_idx

    def select_env(self, env_idx: int) -> None:
        """Show environment `env_idx` modulo `num_envs`; release a push on the previous one."""
        self._push.release(self.env.unwrapped.sim)
        self.env_idx = env_idx % self.env.unwrapped.num_envs
        self._rewards.clear()

    def _on_key(self, key: int) -> None:
        # Called in the window's thread; the main thread performs the action.
        binding = _BINDINGS.get(key)
        if binding is not None:
            self.request_action(binding.action.value, binding.payload)
        if self._user_key_callback is not None:
            self._user_key_callback(key)

    def _configure_window(self, handle: mujoco.viewer.Handle) -> None:
        self._view.apply(handle.cam, self.mjd.xpos)
        if self._view.body_id is not None and not self._com_differs:
            handle.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            handle.cam.trackbodyid = self._view.body_id
        handle.opt.frame = mujoco.mjtFrame.mjFRAME_WORLD
        handle.opt.flags[mujoco.mjtVisFlag.mjVIS_SCLINERTIA] = 1
        handle.opt.geomgroup[:] = self.cfg.geom_group
        handle.opt.sitegroup[:] = self.cfg.site_group
        flags = handle.user_scn.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self.cfg.enable_shadows
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self.cfg.enable_reflections

    def _load_selected(self) -> None:
        sim = self.env.unwrapped.sim
        sync_model_fields(self.mjm, sim.model, sim.expanded_fields, self.env_idx)
        copy_state(sim, self.env_idx, self.mjd)
        mujoco.mj_forward(self.mjm, self.mjd)
        move_sun(self.mjm, self.mjd, self._view.target(self.mjd.xpos))

    def _update_debug_visualizers(self, viewer: mujoco.viewer.Handle) -> None:
        """Replace the geoms of `viewer.user_scn` with the environment's debug drawings.

        Called for every displayed frame with the window locked, even while `_show_debug_vis` is
        False. Subclasses may override it to draw more.
        """
        viewer.user_scn.ngeom = 0
        if self._show_debug_vis:
            visualizer = self._visualizer_of(viewer.user_scn)
            visualizer.begin(self.env_idx, self._show_all_envs)
            self.env.unwrapped.update_visualizers(visualizer)

    def _visualizer_of(self, scn: mujoco.MjvScene) -> MujocoNativeDebugVisualizer:
        if self._visualizer is None or self._visualizer.scn is not scn:
            self._visualizer = MujocoNativeDebugVisualizer(scn, self.mjm)
        return self._visualizer

    @property
    def _com_differs(self) -> bool:
        """True if the center of mass differs per environment.

        A tracking camera follows the center of mass and would jump between environments, so the
        camera then follows the body's origin.
        """
        return bool(self.env.unwrapped.sim.expanded_fields & VIEWER_INERTIAL_FIELDS)

    def _draw_neighbors(self, scn: mujoco.MjvScene) -> None:
        """Draw the nearest environments, and a red arrow above the one in view."""
        if self._marked_body is not None:
            tip = self.mjd.xpos[self._marked_body] + np.array([0.0, 0.0, 0.5])
            start = tip + np.array([0.0, 0.0, 0.4])
            self._visualizer_of(scn).add_arrow(start, tip, _MARKER_COLOR, width=0.03)
        env, sim = self.env.unwrapped, self.env.unwrapped.sim
        origins = to_numpy(env.scene.env_origins)
        option = mujoco.MjvOption()
        option.geomgroup[:] = self.cfg.geom_group
        option.sitegroup[:] = self.cfg.site_group
        for env_idx in nearest_envs(origins, self.env_idx, self.cfg.max_extra_envs):
            sync_model_fields(self._extra_model, sim.model, sim.expanded_fields, env_idx)
            copy_state(sim, env_idx, self._extra_data)
            compute_poses(self._extra_model, self._extra_data)
            add_moving_geoms(scn, self._extra_model, self._extra_data, option)

    def _overlay(self) -> list[tuple[int | None, int | None, str | None, str | None]]:
        status = self.get_status()
        state = "paused" if status.paused else "CAPPED" if status.capped else "running"
        realtime = f"{status.actual_realtime:.2f}x of {status.target_realtime:g}x"
        rows = [
            ("env", f"{self.env_idx + 1}/{self.env.unwrapped.num_envs}"),
            ("step", f"{status.step_count}"),
            ("status", state),
            ("speed", status.speed_label),
            ("real time", f"{realtime} ({status.smoothed_fps:.0f} FPS)"),
        ]
        if status.last_error is not None:
            rows.append(("error", status.last_error[:80]))
        font = int(mujoco.mjtFontScale.mjFONTSCALE_150)
        top, bottom = mujoco.mjtGridPos.mjGRID_TOPLEFT, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT
        names, values = ("\n".join(column) for column in zip(*rows, strict=True))
        steering = STEERING_HELP if self.env.unwrapped.command_manager.steerable else ()
        keys, meanings = ("\n".join(column) for column in zip(*steering, *KEY_HELP, strict=True))
        return [(font, int(top), names, values), (font, int(bottom), keys, meanings)]


def require_display() -> None:
    """Check that a window can be opened; without a display GLFW would end the program.

    Raises:
        RenderingUnavailableError: No display found.
    """
    if sys.platform != "linux":
        return
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderingUnavailableError(
            "MuJoCo's window: expected a display, but DISPLAY and WAYLAND_DISPLAY are not set; "
            "use the browser viewer (--viewer viser)."
        )
    import glfw

    if not glfw.init():
        raise RenderingUnavailableError(
            f"MuJoCo's window cannot open on DISPLAY={os.environ.get('DISPLAY')!r}: the display "
            "server does not answer; use the browser viewer (--viewer viser)."
        )


class MousePush:
    """Conversion of the window's mouse force into `qfrc_applied` of one environment.

    Wrenches of the task stay in `xfrc_applied`. The push adds to generalized forces of the task,
    which are restored when the push ends.
    """

    def __init__(self, model: mujoco.MjModel):
        self._model = model
        self._env_idx: int | None = None
        self._base: np.ndarray | None = None
        self._written = np.zeros(0)

    @property
    def active(self) -> bool:
        """True if a mouse force is applied to an environment."""
        return self._env_idx is not None

    def apply(
        self, sim: Any, env_idx: int, data: mujoco.MjData, perturb: mujoco.MjvPerturb
    ) -> None:
        """Write the force of `perturb`, acting on the state in `data`, for the next step."""
        if not perturb.active or perturb.select <= 0:
            self.release(sim)
            return
        if self._env_idx != env_idx:
            self.release(sim)
        # If a reset or the task overwrote the row, its values are those of the task.
        if self._base is None or not np.array_equal(_row(sim, env_idx), self._written):
            self._base = _row(sim, env_idx)
        self._env_idx = env_idx
        scripted = data.xfrc_applied.copy()
        data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(self._model, data, perturb)
        wrench = data.xfrc_applied[perturb.select].copy()
        data.xfrc_applied[:] = scripted
        force, point = np.zeros(self._model.nv), data.xipos[perturb.select]
        mujoco.mj_applyFT(self._model, data, wrench[:3], wrench[3:], point, perturb.select, force)
        self._write(sim, env_idx, self._base + force)

    def release(self, sim: Any) -> None:
        """Remove the push; forces applied by the environment stay."""
        if self._env_idx is None or self._base is None:
            return
        if np.array_equal(_row(sim, self._env_idx), self._written):
            self._write(sim, self._env_idx, self._base)
        self._env_idx = self._base = None

    def _write(self, sim: Any, env_idx: int, force: np.ndarray) -> None:
        rows = sim.data.qfrc_applied
        rows[env_idx] = torch.as_tensor(force, dtype=rows.dtype, device=rows.device)
        self._written = _row(sim, env_idx)


def _row(sim: Any, env_idx: int) -> np.ndarray:
    return to_numpy(sim.data.qfrc_applied[env_idx]).copy()


def reward_figures(
    history: TermHistory, viewport: mujoco.MjrRect, cfg: PlotCfg
) -> list[tuple[mujoco.MjrRect, mujoco.MjvFigure]]:
    """Return one figure per term and its viewport, for the first `cfg.max_viewports` terms."""
    figures = []
    for place, name in zip(
        compute_viewports(len(history.names), viewport, cfg), history.names, strict=False
    ):
        values = history.values(name)
        exponent, low, high = plot_scale(values, cfg)
        title = name if exponent == 0 else f"{name} (1e{exponent})"
        yrange = (low, high)
        figure = make_empty_figure(title, cfg.grid_size, yrange, cfg.history, cfg.background_alpha)
        figure.flg_extend = 0
        figure.linewidth = 2.0
        figure.range[0][:] = (-cfg.history, 0)
        figure.linergb[0][:] = (0.3, 0.8, 1.0)
        # Points are x, y pairs in one row; non-finite values are left out.
        latest = values[-(figure.linedata.shape[1] // 2) :]
        steps = np.arange(1 - len(latest), 1)
        shown = np.isfinite(latest)
        count = int(shown.sum())
        figure.linepnt[0] = count
        figure.linedata[0, 0 : 2 * count : 2] = steps[shown]
        figure.linedata[0, 1 : 2 * count : 2] = np.clip(latest[shown] / 10.0**exponent, low, high)
        figures.append((place, figure))
    return figures


def compute_viewports(num_plots: int, rect: mujoco.MjrRect, cfg: PlotCfg) -> list[mujoco.MjrRect]:
    """Return the viewports of `num_plots` plots in `rect`: from the top, columns from the right."""
    count = min(num_plots, cfg.max_viewports)
    if count < 1:
        return []
    max_columns = math.ceil(cfg.max_viewports / cfg.max_rows_per_col)
    columns = math.ceil(count / cfg.max_rows_per_col)
    rows = max(math.ceil(count / columns), cfg.min_rows_per_col)
    rows = min(rows, cfg.max_rows_per_col)
    width = int(cfg.plot_strip_fraction * rect.width) // max_columns
    height = rect.height // rows
    right, top = rect.left + rect.width, rect.bottom + rect.height
    cells = (divmod(index, rows) for index in range(count))
    return [
        mujoco.MjrRect(right - (column + 1) * width, top - (row + 1) * height, width, height)
        for column, row in cells
    ]


def make_empty_figure(
    title: str,
    grid_size: tuple[int, int],
    yrange: tuple[float, float],
    history: int,
    alpha: float,
) -> mujoco.MjvFigure:
    """Return a figure whose line 0 has `history` points at x = 0, -1, ... and y = 0.

    Args:
        title: Title of the figure.
        grid_size: Number of grid lines along x and y.
        yrange: Lowest and highest y shown.
        history: Number of points, at most MuJoCo's maximum (1001).
        alpha: Opacity of the black background.
    """
    figure = mujoco.MjvFigure()
    mujoco.mjv_defaultFigure(figure)
    figure.title = title
    figure.gridsize[:] = grid_size
    figure.range[1][:] = yrange
    figure.figurergba[:] = (0.0, 0.0, 0.0, alpha)
    count = min(history, figure.linedata.shape[1] // 2)
    figure.linedata[0, 0 : 2 * count : 2] = -np.arange(count)
    return figure


def plot_scale(values: np.ndarray, cfg: PlotCfg) -> tuple[int, float, float]:
    """Return the exponent of ten to divide a curve by, and its y-range.

    The range spans the percentiles of `cfg`, padded. Curves whose magnitude is outside
    [0.01, 1000) are scaled by a power of ten.
    """
    finite = values[np.isfinite(values)]
    magnitude = float(np.abs(finite).max(initial=0.0))
    if magnitude == 0.0:
        return 0, *cfg.init_yrange
    exponent = 0 if 0.01 <= magnitude < 1000.0 else math.floor(math.log10(magnitude))
    low, high = np.percentile(finite / 10.0**exponent, [cfg.p_lo, cfg.p_hi])
    # Widen the range of a flat curve so that the labels of its axis differ.
    padding = cfg.pad * max(high - low, 0.4 * abs(high), 0.4 * abs(low), cfg.min_span)
    return exponent, float(low - padding), float(high + padding)
