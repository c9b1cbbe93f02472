"""Show the states that led to a NaN in the browser: `uv run viz-nan DUMP`."""

from __future__ import annotations

import copy
import hashlib
import threading
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import viser

from mjlab.cli.flags import parse_flags
from mjlab.cli.main import run_alias
from mjlab.utils.errors import UserError
from mjlab.utils.nan_guard import NanDump
from mjlab.utils.string import escaped
from mjlab.viewer.camera import whole_model_view
from mjlab.viewer.model_sync import VIEWER_MODEL_FIELDS, host_model
from mjlab.viewer.page_server import check_address, page_url, serve_page
from mjlab.viewer.viser.scene import MjlabViserScene

_FIELDS = ("qpos", "qvel", "act", "ctrl", "xfrc_applied", "qacc")
_SHOWN_ENVS = 10


@dataclass(frozen=True)
class VizNanConfig:
    """Flags of `viz-nan`."""

    host: str = "127.0.0.1"
    """Address of the page. `0.0.0.0`: all interfaces."""
    port: int = 8080
    """Port of the page; the next free port if taken."""


def command(argv: list[str], prog: str) -> None:
    """Run `viz-nan`."""
    dump, *flags = argv
    run_viz_nan(dump, parse_flags(VizNanConfig, VizNanConfig(), flags, f"{prog} DUMP"))


def run_viz_nan(path: str, cfg: VizNanConfig) -> None:
    """Serve the page of the dump at `path` until Ctrl-C.

    Raises:
        UserError, ValueError, OSError: invalid address, or see `load_dump`.
    """
    check_address(cfg.host, cfg.port, "--")
    dump, model = load_dump(path)

    server = serve_page(cfg.host, cfg.port)
    page = NanPage(server, dump, model)
    print(f"Serving {path} on {page_url(server)} (Ctrl-C stops).", flush=True)
    try:
        page.run()
    finally:
        server.stop()


def load_dump(path: str) -> tuple[NanDump, mujoco.MjModel]:
    """Return a dump and its model.

    Raises:
        FileNotFoundError: dump or model is missing; the model must be in the folder of the dump.
        ValueError: the file is not a valid dump.
        UserError: the model is damaged, or of another dump.
    """
    dump = NanDump.load(path)
    if not dump.model_file.is_file():
        raise FileNotFoundError(
            f"Dump {path}: model {dump.model_file} not found; copy it to the folder of the dump."
        )
    digest = hashlib.sha256(dump.model_file.read_bytes()).hexdigest()
    # MuJoCo loads most damaged models without an error. Older dumps lack the digest.
    if dump.metadata.get("model_sha256", digest) != digest:
        raise UserError(
            f"Model {dump.model_file}: expected the model of the dump {path}, got a changed or damaged "
            "file; copy both files again."
        )
    try:
        model = mujoco.MjModel.from_binary_path(str(dump.model_file))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise UserError(
            f"Model {dump.model_file}: expected a model written by MuJoCo {mujoco.__version__}, got "
            f"{error}; use the MuJoCo version that wrote the model."
        ) from error
    try:
        size = mujoco.mj_stateSize(model, dump.metadata["state_spec"])
        if size != dump.metadata["state_size"]:
            raise ValueError(f"expected states of size {size}, got {dump.metadata['state_size']}")
        written, data = copy.copy(model), mujoco.MjData(model)
        for step in dump.steps:
            dump.apply(step, 0, written, data)
    except Exception as error:
        raise UserError(
            f"Dump {path}: expected states of the model {dump.model_file.name}, got states of another "
            f"simulation: {error}."
        ) from error
    return dump, model


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


def main() -> None:
    """Entry point of `viz-nan`."""
    run_alias("viz-nan")


if __name__ == "__main__":
    main()
