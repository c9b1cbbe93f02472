"""Page of the states before a NaN: `mjlab viz-nan`."""

from __future__ import annotations

import threading
from typing import Any

import mujoco
import numpy as np
import viser

from mjlab.utils.nan_guard import NanDump
from mjlab.utils.string import escaped
from mjlab.viewer.camera import whole_model_view
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS, host_model
from mjlab.viewer.viser.scene import MjlabViserScene

_FIELDS = ("qpos", "qvel", "act", "ctrl", "xfrc_applied", "qacc")
_SHOWN_ENVS = 10


class NanPage:
    """Page that shows the recorded states, with sliders for substep and environment.

    Controls only request a state; the thread that calls `run` computes and draws the state.
    """

    def __init__(self, server: viser.ViserServer, dump: NanDump, model: mujoco.MjModel) -> None:
        """Build the page and show the last state, which led to the NaN.

        Args:
            server: Server of the page.
            dump: Dump to show.
            model: Model of the dump. Copied; the copy receives the model values of the shown
                environment.
        """
        self.dump = dump
        self.model = host_model(model)
        self.data = mujoco.MjData(self.model)
        self._envs: list[int] = dump.metadata["dumped_env_ids"]
        self._has_visual_changes = any(
            name.removeprefix("model_") in VIEWER_MODEL_FIELDS
            for name in dump.arrays
            if name.startswith("model_")
        )
        self._row_shown = 0
        self._changed = threading.Event()
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        dump.apply(dump.steps[-1], 0, self.model, self.data)
        view = whole_model_view(self.model)
        self.scene = MjlabViserScene(server, self.model, 1, view=view)
        self.scene.set_refresh_handler(self._changed.set)
        tabs = gui.add_tab_group()
        with tabs.add_tab("States", icon=viser.Icon.BUG):
            self._status = gui.add_markdown("")
            self._step = gui.add_slider(
                "Step", 0, max(len(dump.steps) - 1, 1), 1, len(dump.steps) - 1,
                disabled=len(dump.steps) == 1, hint="Recorded substep; the last led to the NaN.",
            )  # fmt: skip
            self._env = gui.add_slider(
                "Environment", 0, max(len(self._envs) - 1, 1), 1, 0,
                visible=len(self._envs) > 1, hint="Recorded environment.",
            )  # fmt: skip
            with gui.add_folder("Scene"):
                self.scene.create_scene_gui(show_debug_viz_control=False)
        with tabs.add_tab("Visualization", icon=viser.Icon.EYE):
            self.scene.create_overlay_gui()
        with tabs.add_tab("Groups", icon=viser.Icon.LAYERS_INTERSECT):
            self.scene.create_groups_gui()
        for slider in (self._step, self._env):
            slider.on_update(lambda _: self._changed.set())
        self.show()

    @property
    def status(self) -> str:
        """Status text above the controls."""
        return self._status.content

    def run(self) -> None:
        """Show requested states, until Ctrl-C."""
        while True:
            if self._changed.wait(timeout=0.2):
                self.show()

    def show(self) -> None:
        """Show the state selected by the sliders."""
        self._changed.clear()
        index = min(int(self._step.value), len(self.dump.steps) - 1)
        row = min(int(self._env.value), len(self._envs) - 1)
        mujoco.mj_resetData(self.model, self.data)
        self.dump.apply(self.dump.steps[index], row, self.model, self.data)
        # MuJoCo does not compute from non-finite states, so body poses are unknown.
        is_finite = all(np.isfinite(getattr(self.data, name)).all() for name in ("qpos", "qvel"))
        if is_finite:
            mujoco.mj_forward(self.model, self.data)
            if row != self._row_shown and self._has_visual_changes:
                self.scene.rebuild_visual_handles()
            self._row_shown = row
            self.scene.update_from_mjdata(self.data)
        self._status.content = self._describe(index, row)

    def _describe(self, index: int, row: int) -> str:
        metadata, env = self.dump.metadata, self._envs[row]
        ids = metadata["nan_env_ids"]
        shown = ", ".join(map(escaped, ids[:_SHOWN_ENVS])) + (
            " ..." if len(ids) > _SHOWN_ENVS else ""
        )
        # Non-finite fields, or the largest values.
        bad = [name for name in _FIELDS if not np.isfinite(getattr(self.data, name)).all()]
        findings = [f"Not finite here: {', '.join(bad)}"]
        if not bad:
            names = ("qvel", "qacc") if self.model.nv > 0 else ()
            largest = {name: _largest(self.model, getattr(self.data, name)) for name in names}
            findings = [f"Largest |{name}|: {value}" for name, value in largest.items()]
        lines = [
            f"**Substep {self.dump.steps[index]}** ({index + 1} of {len(self.dump.steps)} recorded; "
            f"NaN found after substep {metadata['detection_step'] - 1})",
            f"**Environment {escaped(env)}**: {'went NaN' if env in ids else 'clean'}",
            f"Environments with NaN: {shown} ({len(ids)} of {metadata['num_envs_total']})",
            *findings,
        ]
        return "\n\n".join(lines)


def _largest(model: mujoco.MjModel, values: Any) -> str:
    dof = int(np.abs(values).argmax())
    joint = int(model.dof_jntid[dof])
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"joint {joint}"
    return f"{abs(values[dof]):.3g} ({escaped(name)})"
