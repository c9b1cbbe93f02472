"""Page of one model, with sliders: `mjlab view`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import viser

from mjlab.utils.errors import MjlabError
from mjlab.utils.string import escaped
from mjlab.viewer.camera import whole_model_view
from mjlab.viewer.viser.look import set_theme
from mjlab.viewer.viser.scene import MjlabViserScene

_FRAME_TIME = 1.0 / 30.0
_SECONDS_BETWEEN_SLIDERS = 0.2
_MAX_LISTED = 60
# Distance of the camera, in extents of the model.
_DISTANCE = 1.8
# Limits of sliders for joints and actuators without a range.
_HINGE_LIMIT, _SLIDE_LIMIT, _CTRL_LIMIT = 3.1416, 1.0, 1.0
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
_KEY, _JOINT, _ACTUATOR = (
    mujoco.mjtObj.mjOBJ_KEY,
    mujoco.mjtObj.mjOBJ_JOINT,
    mujoco.mjtObj.mjOBJ_ACTUATOR,
)


class ModelPage:
    """Page of one model: joint and actuator sliders, physics, keyframes and MuJoCo's overlays.

    Controls change the state under a lock; the thread that calls `run` steps and draws.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        title: str,
        model: mujoco.MjModel,
        reload: Callable[[], mujoco.MjModel],
    ) -> None:
        """Build the page, with the physics paused.

        Args:
            server: Server of the page.
            title: Name of the model.
            model: Compiled model.
            reload: Returns the model again, for the button Reload; raises `UserError` if it is
                damaged.
        """
        self._server, self._title, self._reload = server, title, reload
        self._lock = threading.RLock()
        self._next: mujoco.MjModel | None = None
        self._changed = threading.Event()
        # Simulated time that displayed time is ahead (s).
        self._ahead = 0.0
        # Time since the joint sliders were updated (s).
        self._shown_ago = 0.0
        set_theme(server)
        self._build(model)

    def run(self) -> None:
        """Step the physics in real time if not paused, and draw, until Ctrl-C."""
        last = time.perf_counter()
        while True:
            time.sleep(_FRAME_TIME)
            now = time.perf_counter()
            self.advance(min(now - last, 2.0 * _FRAME_TIME))
            last = now

    def advance(self, seconds: float) -> None:
        """Advance the physics by `seconds` unless paused, and draw changes."""
        with self._lock:
            if self._next is not None:
                model, self._next = self._next, None
                self._server.gui.reset()
                self._server.scene.reset()
                self._build(model)
            if self.playing.value:
                self._ahead += seconds
                while self._ahead >= self.model.opt.timestep and self.playing.value:
                    self._ahead -= self.model.opt.timestep
                    mujoco.mj_step(self.model, self.data)
                    self._stop_if_diverged()
                self._changed.set()
                self._shown_ago += seconds
                if self._shown_ago >= _SECONDS_BETWEEN_SLIDERS:
                    self._show_joints()
            if self._changed.is_set() or self.scene.needs_update:
                self._changed.clear()
                mujoco.mj_forward(self.model, self.data)
                self.scene.update_from_mjdata(self.data)

    def _stop_if_diverged(self) -> None:
        # MuJoCo resets diverged states, and counts them.
        if any(self.data.warning[kind].number for kind in _DIVERGED):
            self.playing.value, self._ahead = False, 0.0
            self.message.content = (
                f"**The physics diverged** at a timestep of {self.model.opt.timestep:g} s, and is paused. A "
                "smaller timestep, an armature, or weaker gains may help."
            )
            self.set_pose(self.pose.value)

    def _build(self, model: mujoco.MjModel) -> None:
        gui = self._server.gui
        # Frames and joints of a model without geoms would have no size.
        model.stat.meansize = max(model.stat.meansize, 0.01 * model.stat.extent, 1e-4)
        self.model, self.data = model, mujoco.MjData(model)
        self.joints: dict[str, viser.GuiSliderHandle[float]] = {}
        self.actuators: dict[str, viser.GuiSliderHandle[float]] = {}
        view = replace(whole_model_view(model), distance=_DISTANCE * float(model.stat.extent))
        self.scene = MjlabViserScene(self._server, model, 1, view=view)
        self.scene.set_refresh_handler(self._changed.set)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Model", icon=viser.Icon.ROBOT):
            gui.add_markdown(describe_model(self._title, model))
            self.message = gui.add_markdown("")
            self.playing = gui.add_checkbox("Run physics", False)
            gui.add_button("Reload", icon=viser.Icon.REFRESH).on_click(lambda _: self.reload())
            keys = [_name(model, _KEY, key) for key in range(model.nkey)]
            first = keys[0] if keys else "initial"
            self.pose = gui.add_dropdown("Pose", ["initial", *keys], initial_value=first)
            gui.add_button("Set pose").on_click(lambda _: self.set_pose(self.pose.value))
            with gui.add_folder("Scene"):
                self.scene.create_scene_gui(show_debug_viz_control=False)
        with tabs.add_tab("Joints", icon=viser.Icon.ADJUSTMENTS):
            self._add_joint_sliders()
            self._add_actuator_sliders()
        with tabs.add_tab("Visualization", icon=viser.Icon.EYE):
            self.scene.create_overlay_gui()
        self.scene.create_groups_gui(tabs)
        self.set_pose(first)

    def reload(self) -> None:
        """Load the model again; a damaged one leaves the page as it is, with the message."""
        try:
            self._next = self._reload()
        except MjlabError as error:
            self.message.content = f"**Not reloaded.** {escaped(error)}"

    def set_pose(self, name: str) -> None:
        """Set a keyframe by name, or the `initial` pose of the model."""
        with self._lock:
            key = next(
                (k for k in range(self.model.nkey) if _name(self.model, _KEY, k) == name), None
            )
            if key is None:
                mujoco.mj_resetData(self.model, self.data)
            else:
                mujoco.mj_resetDataKeyframe(self.model, self.data, key)
            self._show_joints()
            for actuator, slider in self.actuators.items():
                slider.value = float(
                    self.data.actuator(_index(self.model, _ACTUATOR, actuator)).ctrl[0]
                )
            self._changed.set()

    def _show_joints(self) -> None:
        self._shown_ago = 0.0
        for joint, slider in self.joints.items():
            value = float(self.data.joint(_index(self.model, _JOINT, joint)).qpos[0])
            slider.value = min(max(value, slider.min), slider.max)

    def _add_joint_sliders(self) -> None:
        model = self.model
        with self._server.gui.add_folder("Joints (rad, m)"):
            for joint in range(model.njnt):
                kind, name = int(model.jnt_type[joint]), _name(model, _JOINT, joint)
                if kind not in (_HINGE, _SLIDE):
                    continue
                limit = _HINGE_LIMIT if kind == _HINGE else _SLIDE_LIMIT
                bounds = model.jnt_range[joint] if model.jnt_limited[joint] else (-limit, limit)
                self.joints[name] = self._add_slider(name, bounds, "qpos")

    def _add_actuator_sliders(self) -> None:
        model = self.model
        with self._server.gui.add_folder("Actuators (ctrl)"):
            for actuator in range(model.nu):
                name = _name(model, _ACTUATOR, actuator)
                joint = int(model.actuator_trnid[actuator, 0])
                drives_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
                bounds: Any = (-_CTRL_LIMIT, _CTRL_LIMIT)
                if model.actuator_ctrllimited[actuator]:
                    bounds = model.actuator_ctrlrange[actuator]
                elif drives_joint and model.jnt_limited[joint]:
                    bounds = model.jnt_range[joint]
                self.actuators[name] = self._add_slider(name, bounds, "ctrl")

    def _add_slider(self, name: str, bounds: Any, target: str) -> viser.GuiSliderHandle[float]:
        """Add a slider that writes `qpos` of a joint or `ctrl` of an actuator."""
        low, high = float(bounds[0]), float(bounds[1])
        slider = self._server.gui.add_slider(
            name, low, high, max((high - low) / 500.0, 1e-6), min(max(0.0, low), high)
        )

        @slider.on_update
        def _(event: viser.GuiEvent) -> None:
            # Values set by the page itself have no client.
            if event.client is not None:
                self.set_value(name, target, slider.value)

        return slider

    def set_value(self, name: str, target: str, value: float) -> None:
        """Set `qpos` of a joint or `ctrl` of an actuator by name."""
        with self._lock:
            if target == "qpos":
                self.data.joint(_index(self.model, _JOINT, name)).qpos = value
            else:
                self.data.actuator(_index(self.model, _ACTUATOR, name)).ctrl = value
            self._changed.set()


def describe_model(title: str, model: mujoco.MjModel) -> str:
    """Return sizes, mass and joints of a model as Markdown."""
    kinds = {0: "free", 1: "ball", _SLIDE: "slide", _HINGE: "hinge"}
    lines = [
        f"**{escaped(title)}**",
        "",
        f"{model.nbody - 1} bodies, {model.ngeom} geoms, {model.nu} actuators, {model.nsensor} sensors; "
        f"nq {model.nq}, nv {model.nv}. Mass {model.body_mass.sum():.3g} kg, timestep "
        f"{model.opt.timestep:g} s.",
        "",
        "| joint | type | range |",
        "| --- | --- | --- |",
    ]
    for joint in range(min(model.njnt, _MAX_LISTED)):
        kind = int(model.jnt_type[joint])
        low, high = model.jnt_range[joint]
        unit = "rad" if kind == _HINGE else "m"
        limits = f"{low:.3g} to {high:.3g} {unit}" if model.jnt_limited[joint] else "unlimited"
        lines.append(f"| {escaped(_name(model, _JOINT, joint))} | {kinds[kind]} | {limits} |")
    if model.njnt > _MAX_LISTED:
        lines.append(f"| ... {model.njnt - _MAX_LISTED} more | | |")
    return "\n".join(lines)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"{index}"


def _index(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """Return the index of the element that `_name` names."""
    index = mujoco.mj_name2id(model, kind, name)
    return index if index >= 0 else int(name)
