"""Browser viewer of a policy during training."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from mjlab.utils.string import duration, number
from mjlab.viewer.viser.viewer import ViserPlayViewer

if TYPE_CHECKING:
    import viser

    from mjlab.viewer.base import EnvProtocol, PolicyProtocol

# Polling periods (s): for browsers while none is connected, for new weights, for the panel.
_SLEEP_UNWATCHED = 0.25
_WEIGHTS_PERIOD = 0.25
_PANEL_PERIOD = 0.5

Stats = Mapping[str, Any]


class LiveViewer(ViserPlayViewer):
    """Viewer that plays the newest policy of a training run and shows the training progress.

    Without a connected browser, the viewer neither steps nor draws.
    """

    # Low rate, to leave the cores to training.
    scene_period = 1.0 / 20.0

    def __init__(
        self,
        env: EnvProtocol,
        policy: PolicyProtocol,
        viser_server: viser.ViserServer,
        title: str,
        take_stats: Callable[[], Stats | None],
        set_watched: Callable[[bool], None],
    ) -> None:
        """Prepare the viewer.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions; `take_stats` changes its weights.
            viser_server: Server of the page.
            title: Name of the task.
            take_stats: Loads new weights; returns the statistics (`IterationStats`) of their iteration, or
                None if unchanged.
            set_watched: Called with True when a browser connects, False when the last one disconnects.
        """
        super().__init__(env, policy, frame_rate=20.0, viser_server=viser_server)
        self._title = title
        self._take_stats = take_stats
        self._set_watched = set_watched
        self._watched: bool | None = None
        self._stats: Stats | None = None
        self._stats_time = 0.0
        self._next_weights = self._next_panel = 0.0
        self._panel: viser.GuiHtmlHandle | None = None

    def tick(self) -> bool:
        """Step, draw and load weights if a browser is connected; otherwise sleep."""
        watched = bool(self._server.get_clients())
        if watched != self._watched:
            self._watched = watched
            self._set_watched(watched)
        if not watched:
            time.sleep(_SLEEP_UNWATCHED)
            # The simulation is paused as well.
            self._last_tick = time.perf_counter()
            return True
        now = time.perf_counter()
        if now >= self._next_weights:
            self._next_weights = now + _WEIGHTS_PERIOD
            stats = self._take_stats()
            if stats is not None:
                self._stats, self._stats_time = stats, now
        if now >= self._next_panel:
            self._next_panel = now + _PANEL_PERIOD
            self._show_progress()
        return super().tick()

    def add_first_panels(self) -> None:
        """Add the panel of training progress."""
        with self._server.gui.add_folder("Training"):
            self._panel = self._server.gui.add_html("")
        self._show_progress()

    def _show_progress(self) -> None:
        if self._panel is not None:
            age = time.perf_counter() - self._stats_time
            content = progress_html(self._title, self._stats, age)
            if content != self._panel.content:
                self._panel.content = content


def progress_html(title: str, stats: Stats | None, age: float) -> str:
    """Return the training progress as HTML, with a progress bar.

    Args:
        title: Name of the task.
        stats: Statistics of the shown policy's iteration; None before the first iteration.
        age: Age of the policy (s).
    """
    name = f"<div><strong>{html.escape(title)}</strong></div>"
    style = "padding:0.25em 1em;font-size:0.85em;line-height:1.5"
    if stats is None:
        return f'<div style="{style}">{name}Waiting for the first iteration …</div>'
    done, total = stats["iteration"], stats["total_iterations"]
    bar = (
        '<div style="background:rgba(128,128,128,0.2);border-radius:2px;margin:0.3em 0">'
        f'<div style="width:{100.0 * done / max(total, 1):.1f}%;height:6px;background:#1c7ed6;'
        'border-radius:2px"></div></div>'
    )
    left, value = stats["time_left"], stats["exploring_return"]
    unit = "Return" if value is not None else "Reward per step"
    value = stats["mean_step_reward"] if value is None else value
    rows = [
        ("Iteration", f"{done:,} of {total:,}"),
        ("Time", "starting …" if left is None else f"at most {duration(left)} left"),
        (unit, f"{number(value)}, exploring"),
        ("Speed", f"{stats['steps_per_second']:,.0f} steps/s"),
        ("Policy", f"{age:.0f} s old"),
    ]
    if stats["exploring_length"] is not None:
        rows.insert(3, ("Episodes", f"{stats['exploring_length']:,.0f} steps"))
    lines = "".join(f"<div><strong>{row}:</strong> {value}</div>" for row, value in rows)
    lines += (
        '<div style="opacity:0.6">The view runs at low priority; training takes precedence.</div>'
    )
    return f'<div style="{style}">{name}{bar}{lines}</div>'
