"""Browser panel of a motion command: frame selection and body errors."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from mjlab.utils.lab_api.math import quat_error_magnitude
from mjlab.utils.string import encodable, escaped

if TYPE_CHECKING:
    import viser

    from mjlab.tasks.tracking.mdp.commands import MotionCommand

_TABLE_PERIOD_S = 0.25
_MAX_OFFSET = 2.0


class MotionPanel:
    """Panel to move the reference of the displayed environment, and to start robots on a frame.

    While the viewer runs, the slider follows the reference; while it is paused, the reference
    follows the slider. Callbacks run in other threads: they only store requests. The viewer calls
    `update` and `take_start` between steps to execute them.
    """

    def __init__(
        self,
        name: str,
        server: viser.ViserServer,
        command: MotionCommand,
        get_env_idx: Callable[[], int],
        on_change: Callable[[], None] | None = None,
        request_action: Callable[[str, Any], None] | None = None,
    ) -> None:
        """Add the panel to the current GUI container.

        Args:
            name: Title of the panel.
            server: Viser server.
            command: Command whose reference is moved.
            get_env_idx: Returns the index of the displayed environment.
            on_change: Called after every change, to redraw the scene.
            request_action: Queues a viewer action. None: no start button.
        """
        self._command, self._get_env_idx = command, get_env_idx
        self._on_change = on_change or (lambda: None)
        self._request_action = request_action
        self._paused = False
        self._requested: tuple[int, int] | None = None
        self._start: tuple[int, int] | None = None
        # True if the user moved the reference, which then is not one frame ahead of the robot.
        self._was_moved = False
        self._next_table = 0.0
        names = [encodable(name) for name in command.motion.names]
        gui, self._names = server.gui, names
        with gui.add_folder(name.capitalize()):
            self._motion = gui.add_dropdown(
                "Motion", names, initial_value=names[0], disabled=True, visible=len(names) > 1
            )
            last = int(command.motion.lengths[0]) - 1
            self._frame = gui.add_slider("Frame", 0, last, 1, 0, disabled=True)
            button = gui.add_button("Start Here", visible=request_action is not None)
            self._all_envs = gui.add_checkbox("All envs", True, visible=command.num_envs > 1)
            beside = gui.add_slider(
                "Ghost beside (m)", -_MAX_OFFSET, _MAX_OFFSET, 0.1, float(command.drawing.offset[1])
            )
            with gui.add_folder("Errors", expand_by_default=False):
                self._table = gui.add_markdown("")
        self._frame.on_update(self._on_select)
        self._motion.on_update(self._on_select)
        button.on_click(self._start_here)

        @beside.on_update
        def _(_event: Any) -> None:
            command.drawing.offset[1] = beside.value
            self._on_change()

    def set_paused(self, paused: bool) -> None:
        """Store the pause state; enable frame and motion selection while paused."""
        self._paused = paused
        self._frame.disabled = self._motion.disabled = not paused

    def take_start(self) -> tuple[int, int] | None:
        """Return and clear the start requested by the button: motion and frame, or None."""
        start, self._start = self._start, None
        if start is not None:
            # The robot moves to the reference, which completes the pending request.
            self._requested, self._was_moved = None, False
            self._next_table = 0.0
        return start

    def update(self) -> None:
        """Move the reference to the slider while paused, else the slider to the reference."""
        command, index = self._command, self._get_env_idx()
        if not 0 <= index < command.num_envs:
            return
        requested, self._requested = self._requested, None
        if requested is not None and self._paused:
            command.motion_ids[index], command.time_steps[index] = requested
            command.update_relative_body_poses()
            self._was_moved = True
        elif not self._paused:
            self._was_moved = False
        motion, frame = int(command.motion_ids[index]), int(command.time_steps[index])
        last = int(command.motion.lengths[motion]) - 1
        if self._frame.max != last:
            self._frame.max = last
        if self._frame.value != frame:
            self._frame.value = frame
        if self._motion.value != self._names[motion]:
            self._motion.value = self._names[motion]
        now = time.perf_counter()
        if now >= self._next_table or requested is not None:
            self._next_table = now + _TABLE_PERIOD_S
            self._table.content = self._errors_of(index)

    def _errors_of(self, index: int) -> str:
        """Return a Markdown table of the errors of each tracked body of an environment."""
        command = self._command
        frame = command.current_frame if self._was_moved else command.matching_frame
        pos = frame.robot_body_pos_w[index]
        distance = torch.linalg.vector_norm(frame.body_pos_relative_w[index] - pos, dim=-1)
        in_world = torch.linalg.vector_norm(frame.body_pos_w[index] - pos, dim=-1)
        angle = quat_error_magnitude(
            frame.body_quat_relative_w[index], frame.robot_body_quat_w[index]
        )
        rows = zip(
            frame.body_names, distance.tolist(), in_world.tolist(), angle.tolist(), strict=True
        )
        lines = ["| body | m | in the world (m) | rad |", "| --- | --- | --- | --- |"]
        lines += [
            f"| {escaped(name)} | {near:.3f} | {far:.3f} | {turn:.3f} |"
            for name, near, far, turn in rows
        ]
        return "\n".join(lines)

    def _on_select(self, event: Any) -> None:
        # Updates by the panel itself have no client.
        if event.client is None or not self._paused:
            return
        motion = self._names.index(self._motion.value)
        last = int(self._command.motion.lengths[motion]) - 1
        self._requested = motion, min(int(self._frame.value), last)
        self._on_change()

    def _start_here(self, _event: Any) -> None:
        motion = self._names.index(self._motion.value)
        self._start = motion, int(self._frame.value)
        if self._request_action is not None:
            payload = {"type": "gui_reset", "all_envs": bool(self._all_envs.value)}
            self._request_action("start_here", payload)
