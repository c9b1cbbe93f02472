"""The panel of a motion command in the browser: choosing a frame, and the errors of the bodies."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from mjlab.utils.lab_api.math import quat_error_magnitude

if TYPE_CHECKING:
    import numpy as np
    import viser

    from mjlab.tasks.tracking.mdp.motion_library import MotionLibrary, MotionReader

_TABLE_PERIOD_S = 0.25
_MAX_OFFSET = 2.0


class MotionPanel:
    """Moves the reference of the environment in view, and starts robots on a frame.

    While the viewer plays, the slider follows the reference; while it is paused, the reference
    follows the slider. Callbacks come in other threads: they only take down what is asked for, and
    `update` and `take_start`, which the viewer calls between steps, do it.
    """

    def __init__(
        self,
        name: str,
        server: viser.ViserServer,
        motion: MotionLibrary,
        num_envs: int,
        ghost_offset: np.ndarray,
        *,
        get_env_idx: Callable[[], int],
        get_frame: Callable[[int], tuple[int, int]],
        set_frame: Callable[[int, int, int], None],
        get_matching: Callable[[], MotionReader],
        get_current: Callable[[], MotionReader],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add the panel to the current place in the page.

        Args:
            name: Title of the panel.
            server: The page's server.
            motion: Motions to choose from.
            num_envs: Number of environments.
            ghost_offset: (3,) from the reference to where it is drawn (m); the slider edits it.
            get_env_idx: Returns the environment in view.
            get_frame: Returns motion and frame of an environment.
            set_frame: Moves the reference of an environment to a motion and a frame.
            get_matching: Returns the reference at the time of the robot's state, beside the robot.
            get_current: Returns the reference as it is, beside the robot.
            on_change: Called after every change, so that the scene is drawn anew.
            request_action: Queues an action of the viewer; without it, there is no button.
        """
        self._library, self._num_envs = motion, num_envs
        self._get_env_idx, self._get_frame, self._set_frame = get_env_idx, get_frame, set_frame
        self._get_matching, self._get_current = get_matching, get_current
        self._on_change, self._request_action = on_change, request_action
        self._paused = False
        self._wanted: tuple[int, int] | None = None
        self._start: tuple[int, int] | None = None
        # Whether the reference was moved by hand, and so is not a frame ahead of the robot.
        self._was_moved = False
        self._next_table = 0.0
        gui, names = server.gui, list(motion.names)
        with gui.add_folder(name.capitalize()):
            self._motion = gui.add_dropdown(
                "Motion", names, initial_value=names[0], disabled=True, visible=len(names) > 1
            )
            last = int(motion.lengths[0]) - 1
            self._frame = gui.add_slider("Frame", 0, last, 1, 0, disabled=True)
            button = gui.add_button("Start Here", visible=request_action is not None)
            self._all_envs = gui.add_checkbox("All envs", True, visible=num_envs > 1)
            beside = gui.add_slider(
                "Ghost beside (m)", -_MAX_OFFSET, _MAX_OFFSET, 0.1, float(ghost_offset[1])
            )
            with gui.add_folder("Errors", expand_by_default=False):
                self._table = gui.add_markdown("")
        self._frame.on_update(self._chosen)
        self._motion.on_update(self._chosen)
        button.on_click(self._start_here)

        @beside.on_update
        def _(_event: Any) -> None:
            ghost_offset[1] = beside.value
            self._redraw()

    def set_paused(self, paused: bool) -> None:
        """Hear that the viewer was paused or continued."""
        self._paused = paused
        self._frame.disabled = self._motion.disabled = not paused

    def take_start(self) -> tuple[int, int] | None:
        """Return the motion and the frame that the button asked for, once; else None."""
        start, self._start = self._start, None
        if start is not None:
            # The robot follows to where the reference was moved, and what was chosen is done.
            self._wanted, self._was_moved = None, False
            self._next_table = 0.0
        return start

    def update(self) -> None:
        """Move the reference where the slider is, or the slider where the reference is."""
        index = self._get_env_idx()
        if not 0 <= index < self._num_envs:
            return
        wanted, self._wanted = self._wanted, None
        if wanted is not None and self._paused:
            self._set_frame(index, *wanted)
            self._was_moved = True
        elif not self._paused:
            self._was_moved = False
        motion, frame = self._get_frame(index)
        last = int(self._library.lengths[motion]) - 1
        if self._frame.max != last:
            self._frame.max = last
        if self._frame.value != frame:
            self._frame.value = frame
        if self._motion.value != self._library.names[motion]:
            self._motion.value = self._library.names[motion]
        now = time.perf_counter()
        if now >= self._next_table or wanted is not None:
            self._next_table = now + _TABLE_PERIOD_S
            self._table.content = self._errors_of(index)

    def _errors_of(self, index: int) -> str:
        """Return a table of the errors of each tracked body of an environment."""
        frame = self._get_current() if self._was_moved else self._get_matching()
        pos = frame.robot_body_pos_w[index]
        distance = torch.linalg.vector_norm(frame.body_pos_relative_w[index] - pos, dim=-1)
        in_world = torch.linalg.vector_norm(frame.body_pos_w[index] - pos, dim=-1)
        angle = quat_error_magnitude(
            frame.body_quat_relative_w[index], frame.robot_body_quat_w[index]
        )
        rows = zip(
            frame.body_names, distance.tolist(), in_world.tolist(), angle.tolist(), strict=True
        )
        lines = ["| body | cm | in the world | degrees |", "| --- | --- | --- | --- |"]
        lines += [
            f"| {name} | {100 * near:.1f} | {100 * far:.1f} | {57.2958 * turn:.1f} |"
            for name, near, far, turn in rows
        ]
        return "\n".join(lines)

    def _chosen(self, event: Any) -> None:
        # What the panel itself sets has no client.
        if event.client is None or not self._paused:
            return
        motion = self._library.names.index(self._motion.value)
        last = int(self._library.lengths[motion]) - 1
        self._wanted = motion, min(int(self._frame.value), last)
        self._redraw()

    def _start_here(self, _event: Any) -> None:
        motion = self._library.names.index(self._motion.value)
        self._start = motion, int(self._frame.value)
        if self._request_action is not None:
            payload = {"type": "gui_reset", "all_envs": bool(self._all_envs.value)}
            self._request_action("start_here", payload)

    def _redraw(self) -> None:
        if self._on_change is not None:
            self._on_change()
