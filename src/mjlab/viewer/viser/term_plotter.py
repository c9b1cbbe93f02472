"""Curves of named terms over the last environment steps, one plot a term."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from viser import uplot

from mjlab.viewer.history import TermHistory

PLOT_POINTS = 150
_SHOWN_AT_FIRST = 6
_PLOT_HEIGHT = 120
_COLORS = ("#1c7ed6", "#2f9e44", "#e8590c", "#9c36b5", "#0c8599", "#e03131")


class ViserTermPlotter:
    """Plots the terms that are ticked; a filter and All / None help with long lists."""

    def __init__(self, server: viser.ViserServer, names: list[str]) -> None:
        """Add the selection and the plots to the current place in the page."""
        self._gui = server.gui
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._sent: dict[str, np.ndarray] = {}
        with self._gui.add_folder("Terms", expand_by_default=len(names) > _SHOWN_AT_FIRST):
            self._add_selection(names)
        for index, name in enumerate(names):
            self._plots[name] = self._add_plot(name, _COLORS[index % len(_COLORS)])

    def update(self, history: TermHistory) -> None:
        """Send the points of `history` to the plots that are shown and have changed."""
        for name, plot in self._plots.items():
            if plot.visible:
                self._send(name, plot, history.values(name)[-PLOT_POINTS:])

    def _send(self, name: str, plot: viser.GuiUplotHandle, values: np.ndarray) -> None:
        if np.array_equal(values, self._sent.get(name, np.zeros(0)), equal_nan=True):
            return
        self._sent[name] = values
        # The newest point is at 0, older ones at negative numbers of steps.
        steps = np.arange(1 - len(values), 1, dtype=float)
        plot.data = (steps, values) if len(values) else _EMPTY

    def _add_selection(self, names: list[str]) -> None:
        pattern = self._gui.add_text("Filter", "", hint="Show only terms whose name holds this.")
        buttons = self._gui.add_button_group("Select", ["All", "None"])
        for index, name in enumerate(names):
            box = self._gui.add_checkbox(name, index < _SHOWN_AT_FIRST)
            box.on_update(lambda _: self._refresh(pattern.value))
            self._boxes[name] = box

        @pattern.on_update
        def _(_: Any) -> None:
            self._refresh(pattern.value)

        @buttons.on_click
        def _(event: Any) -> None:
            for box in self._boxes.values():
                if box.visible:
                    box.value = event.target.value == "All"
            self._refresh(pattern.value)

    def _refresh(self, pattern: str) -> None:
        for name, box in self._boxes.items():
            box.visible = pattern.lower() in name.lower()
            self._plots[name].visible = box.visible and box.value

    def _add_plot(self, name: str, color: str) -> viser.GuiUplotHandle:
        return self._gui.add_uplot(
            _EMPTY,
            (
                uplot.Series(label="steps ago"),
                uplot.Series(label=name, stroke=color, width=1.5, points={"show": False}),
            ),
            title=name,
            scales={"x": uplot.Scale(time=False, range=(1 - PLOT_POINTS, 0))},
            legend=uplot.Legend(show=False),
            height=_PLOT_HEIGHT,
            padding=(8, 24, 0, 0),
            visible=self._boxes[name].value,
        )


_EMPTY = (np.zeros(1), np.full(1, np.nan))
