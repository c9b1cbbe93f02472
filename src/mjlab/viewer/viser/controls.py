"""Status and the buttons that run, pause, step and reset."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import Any

import viser

from mjlab.viewer.base import ViewerStatus

_SPEED_ACTIONS = {"Slower": "speed_down", "1x": "reset_speed", "Faster": "speed_up"}


class SimulationControls:
    """The Info and Simulation parts of the Controls tab."""

    def __init__(self, server: viser.ViserServer, request_action: Callable[..., None]) -> None:
        """Add the controls to the current place in the page.

        Args:
            server: The page's server.
            request_action: Queues a viewer action by name for the main thread.
        """
        gui = server.gui
        with gui.add_folder("Info"):
            self._status = gui.add_html("")
        self._shown = ""
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

        @speed.on_click
        def _(event: Any) -> None:
            request_action(_SPEED_ACTIONS[event.target.value])

    def show_paused(self, paused: bool) -> None:
        """Let the buttons say what they now do."""
        self._pause.label = "Play" if paused else "Pause"
        self._pause.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE
        self._step.disabled = not paused

    def show_status(self, status: ViewerStatus) -> None:
        """Show the status where it differs from what is shown."""
        content = status_html(status)
        if content != self._shown:
            self._shown = self._status.content = content


def status_html(status: ViewerStatus) -> str:
    """The status as a small table."""
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
        error = html.escape(status.last_error)
        rows.append(("Error", f'<span style="color:#e03131">{error}</span>'))
    lines = "".join(f"<div><strong>{name}:</strong> {value}</div>" for name, value in rows)
    return f'<div style="padding:0.25em 1em;font-size:0.85em;line-height:1.5">{lines}</div>'
