"""Browser viewer of a policy during training."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from viser import uplot

from mjlab.utils.string import escaped
from mjlab.viewer.viser.viewer import ViserPlayViewer

if TYPE_CHECKING:
    import viser

    from mjlab.viewer.base import EnvProtocol, PolicyProtocol

# Polling periods (s): for browsers while none is connected, for new weights, for the panel.
_SLEEP_UNWATCHED = 0.25
_WEIGHTS_PERIOD = 0.25
_PANEL_PERIOD = 0.5
_PLOT_HEIGHT = 150
_EXPLORING, _EVALUATED, _GOAL = "#1c7ed6", "#e8590c", "#2f9e44"


Progress = Mapping[str, Any]
"""Progress of training:

- `iteration`, `total_iterations`: finished iterations, and those of the run.
- `rows`: further values as (name, text).
- `unit`: unit of `curve`.
- `curve`, `evaluations`: mean of exploring and of evaluated episodes, by iteration.
- `goal`: mean of evaluations that solves the task, None without.
- `time`: time at which the policy was written (s since the epoch).
"""


class LiveViewer(ViserPlayViewer):
    """Viewer that plays the newest policy of a training run beside the learning curve.

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
        take_progress: Callable[[], Progress | None],
        on_ready: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare the viewer.

        Args:
            env: Environment or wrapper whose observations `policy` takes.
            policy: Maps observations to actions; `take_progress` changes its weights.
            viser_server: Server of the page.
            title: Name of the task.
            take_progress: Loads new weights; returns the progress of training, or None if unchanged.
            on_ready: Called once the page is filled.
        """
        super().__init__(env, policy, frame_rate=20.0, viser_server=viser_server)
        self._title = title
        self._take_progress = take_progress
        self._on_ready = on_ready
        self._progress: Progress | None = None
        self._next_weights = self._next_panel = 0.0
        self._panel: viser.GuiHtmlHandle | None = None
        self._plot: viser.GuiUplotHandle | None = None

    def setup(self) -> None:
        """Fill the page."""
        # At once: browsers must not begin with the look that is replaced.
        with self._server.atomic():
            super().setup()
            self.scene.set_plain_look()
        self._on_ready()

    def tick(self) -> bool:
        """Step, draw and load weights if a browser is connected; otherwise sleep."""
        if not self._server.get_clients():
            time.sleep(_SLEEP_UNWATCHED)
            # The simulation is paused as well.
            self._last_tick = time.perf_counter()
            return True
        now = time.perf_counter()
        if now >= self._next_weights:
            self._next_weights = now + _WEIGHTS_PERIOD
            progress = self._take_progress()
            if progress is not None:
                self._progress = progress
                self._show_curve(progress)
        if now >= self._next_panel:
            self._next_panel = now + _PANEL_PERIOD
            self._show_progress()
        return super().tick()

    def add_first_panels(self) -> None:
        """Add progress and learning curve."""
        gui = self._server.gui
        with gui.add_folder("Training"):
            self._panel = gui.add_html(progress_html(self._title, None, 0.0))
            self._plot = gui.add_uplot(
                curve_data({}),
                (
                    uplot.Series(label="iteration"),
                    uplot.Series(label="exploring", stroke=_EXPLORING, width=1.5, points={"show": False}),
                    uplot.Series(label="goal", stroke=_GOAL, width=1, dash=(6, 4), points={"show": False}),
                    uplot.Series(
                        label="evaluated", stroke=_EVALUATED, width=0,
                        points={"show": True, "size": 7, "fill": _EVALUATED},
                    ),
                ),
                scales=curve_scales(curve_data({})),
                legend=uplot.Legend(show=False),
                height=_PLOT_HEIGHT,
                padding=(8, 12, 0, 0),
            )  # fmt: skip

    def _show_progress(self) -> None:
        if self._panel is not None:
            progress = self._progress
            age = 0.0 if progress is None else time.time() - progress["time"]
            self._panel.content = progress_html(self._title, progress, age)

    def _show_curve(self, progress: Progress) -> None:
        if self._plot is not None:
            self._plot.data = curve_data(progress)
            self._plot.scales = curve_scales(self._plot.data)


def curve_data(progress: Progress) -> tuple[np.ndarray, ...]:
    """Return iterations, curve, goal and evaluations of the plot, each (N,); NaN without a value."""
    curve, evaluations = progress.get("curve", {}), progress.get("evaluations", {})
    iterations = sorted({*curve, *evaluations}) or [0]
    goal = dict.fromkeys(iterations, progress.get("goal"))
    columns = [[values.get(i) for i in iterations] for values in (curve, goal, evaluations)]
    # None becomes NaN.
    return tuple(np.array(column, dtype=float) for column in (iterations, *columns))


def curve_scales(data: tuple[np.ndarray, ...]) -> dict[str, uplot.Scale]:
    """Return the scales for `data` of `curve_data`; the plot itself cannot find them among NaN."""
    values = np.concatenate(data[1:])
    values = values[np.isfinite(values)]
    low, high = (values.min(), values.max()) if len(values) else (0.0, 1.0)
    margin = 0.05 * max(high - low, 1e-6 + 1e-3 * abs(high))
    return {
        "x": uplot.Scale(time=False, range=(float(data[0][0]), max(float(data[0][-1]), 1.0))),
        "y": uplot.Scale(range=(float(low - margin), float(high + margin))),
    }


def progress_html(title: str, progress: Progress | None, age: float) -> str:
    """Return the progress as HTML: a bar, values, and the legend of the plot.

    Args:
        title: Name of the task.
        progress: Progress; None until it is read.
        age: Age of the policy (s).
    """
    name = f"<div><strong>{escaped(title)}</strong></div>"
    style = "padding:0.25em 1em;font-size:0.85em;line-height:1.5"
    if progress is None:
        return f'<div style="{style}">{name}Waiting for the policy …</div>'
    done, total = progress["iteration"], progress["total_iterations"]
    bar = (
        '<div style="background:rgba(128,128,128,0.2);border-radius:2px;margin:0.3em 0">'
        f'<div style="width:{100.0 * done / max(total, 1):.1f}%;height:6px;background:#1c7ed6;'
        'border-radius:2px"></div></div>'
    )
    rows = [
        ("iteration", f"{done:,} of {total:,}"),
        *progress["rows"],
        ("policy", f"{age:.0f} s old"),
    ]
    lines = "".join(
        f"<div><strong>{escaped(row.capitalize())}:</strong> {escaped(value)}</div>"
        for row, value in rows
    )
    legend = [(_EXPLORING, f"— {escaped(progress['unit'])}, exploring")]
    if progress["evaluations"]:
        legend.append((_EVALUATED, "● evaluated"))
    if progress["goal"] is not None:
        legend.append((_GOAL, "┅ goal"))
    lines += "".join(
        f'<span style="color:{color};margin-right:1em">{text}</span>' for color, text in legend
    )
    return f'<div style="{style}">{name}{bar}{lines}</div>'
