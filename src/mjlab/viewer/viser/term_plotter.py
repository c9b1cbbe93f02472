"""Plots of terms over the last environment steps, one per term."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import viser
from viser import uplot

from mjlab.utils.string import escaped
from mjlab.viewer.base import TermHistory

_SHOWN_AT_FIRST = 6
_PLOT_HEIGHT = 120
_EMPTY = (np.zeros(1), np.full(1, np.nan))
_COLORS = ("#1c7ed6", "#2f9e44", "#e8590c", "#9c36b5", "#0c8599", "#e03131")


class ViserTermPlotter:
    """Plots of the selected terms, with a name filter and All / None buttons."""

    def __init__(
        self,
        server: viser.ViserServer,
        term_names: list[str],
        name: str = "Reward",
        history_length: int = 150,
        env_idx: int = 0,
    ) -> None:
        """Add the selection and the plots to the current GUI container.

        Args:
            server: The page's server.
            term_names: Names of the terms.
            name: Kind of terms, shown in the panel.
            history_length: Number of points per plot.
            env_idx: Environment of the values, shown in the panel.
        """
        self._gui = server.gui
        self._name = name
        self.history = TermHistory(history_length)
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._sent: dict[str, np.ndarray] = {}
        self._label = self._gui.add_markdown("")
        expanded = len(term_names) > _SHOWN_AT_FIRST
        self._folder = self._gui.add_folder("Terms", expand_by_default=expanded)
        with self._folder:
            self._add_selection(term_names)
        for index, term in enumerate(term_names):
            color = _COLORS[index % len(_COLORS)]
            self._plots[term] = self._gui.add_uplot(
                _EMPTY,
                (
                    uplot.Series(label="steps ago"),
                    uplot.Series(label=term, stroke=color, width=1.5, points={"show": False}),
                ),
                title=term,
                scales={"x": uplot.Scale(time=False, range=(1 - history_length, 0))},
                legend=uplot.Legend(show=False),
                height=_PLOT_HEIGHT,
                padding=(8, 24, 0, 0),
                visible=self._boxes[term].value,
            )
        self.update_env_idx(env_idx)

    def update(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Record a point per term and update the visible plots."""
        self.add(terms)
        self.refresh()

    def add(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Record a point per term; the next `refresh` shows it."""
        self.history.add(terms)

    def refresh(self) -> None:
        """Send the recorded points to the visible plots that changed."""
        for name, plot in self._plots.items():
            if not plot.visible:
                continue
            values = self.history.values(name)
            if np.array_equal(values, self._sent.get(name, np.zeros(0)), equal_nan=True):
                continue
            self._sent[name] = values
            # x = 0 is the newest point; older points have negative x.
            steps = np.arange(1 - len(values), 1, dtype=float)
            plot.data = (steps, values) if len(values) else _EMPTY

    def update_env_idx(self, env_idx: int) -> None:
        """Switch to the values of another environment and clear the recorded points."""
        self._label.content = f"<small>{escaped(self._name)} terms of environment {env_idx}</small>"
        self.clear_histories()

    def clear_histories(self) -> None:
        """Clear the recorded points."""
        self.history.clear()

    def cleanup(self) -> None:
        """Remove the selection and the plots from the page."""
        for handle in (self._label, self._folder, *self._plots.values()):
            handle.remove()
        self._boxes.clear()
        self._plots.clear()

    def _add_selection(self, names: list[str]) -> None:
        pattern = self._gui.add_text("Filter", "", hint="Show terms whose name contains this.")
        buttons = self._gui.add_button_group("Select", ["All", "None"])

        def show_chosen() -> None:
            for name, box in self._boxes.items():
                box.visible = pattern.value.lower() in name.lower()
                self._plots[name].visible = box.visible and box.value

        for index, name in enumerate(names):
            box = self._gui.add_checkbox(name, index < _SHOWN_AT_FIRST)
            box.on_update(lambda _: show_chosen())
            self._boxes[name] = box

        pattern.on_update(lambda _: show_chosen())

        @buttons.on_click
        def _(event: Any) -> None:
            for box in self._boxes.values():
                if box.visible:
                    box.value = event.target.value == "All"
            show_chosen()
