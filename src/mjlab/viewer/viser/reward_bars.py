"""Bars that compare the terms of the reward."""

from __future__ import annotations

import html
import logging

import viser

from mjlab.viewer.history import TermHistory

log = logging.getLogger(__name__)

_WINDOW_STEPS = 60
_POSITIVE, _NEGATIVE = "#2f9e44", "#e03131"


class RewardBarPanel:
    """One bar a reward term: its mean over the last 60 environment steps.

    The longest bar is the largest magnitude; green adds to the reward, red takes from it.
    """

    def __init__(self, server: viser.ViserServer, names: list[str], max_terms: int = 20) -> None:
        """Add the panel to the current place in the page.

        Args:
            server: The page's server.
            names: The reward terms.
            max_terms: Terms shown; the rest are left out, which is logged.
        """
        if len(names) > max_terms:
            log.warning(
                "The reward has %d terms; bars show the first %d. Raise "
                "viewer.reward_bar_max_terms to see more.",
                len(names),
                max_terms,
            )
        self._names = names[:max_terms]
        self._html = server.gui.add_html("")
        self._shown = ""
        self._show(dict.fromkeys(self._names, 0.0))

    def update(self, history: TermHistory) -> None:
        """Show the means of `history`."""
        self._show({name: history.mean(name, _WINDOW_STEPS) for name in self._names})

    def _show(self, means: dict[str, float]) -> None:
        largest = max((abs(value) for value in means.values()), default=0.0) or 1.0
        rows = "".join(_row(name, value, largest) for name, value in means.items())
        content = (
            '<div style="padding:0.25em 1em;font-size:0.8em">'
            f"<div><strong>Mean of the last {_WINDOW_STEPS} steps</strong></div>{rows}</div>"
        )
        if content != self._shown:
            self._shown = self._html.content = content


def _row(name: str, value: float, largest: float) -> str:
    color = _NEGATIVE if value < 0 else _POSITIVE
    width = 100.0 * abs(value) / largest
    return (
        '<div style="margin-top:0.35em">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<span style="overflow-wrap:anywhere">{html.escape(name)}</span>'
        f"<span>{value:+.4f}</span></div>"
        '<div style="background:rgba(128,128,128,0.2);border-radius:2px">'
        f'<div style="width:{width:.1f}%;height:6px;background:{color};border-radius:2px">'
        "</div></div></div>"
    )
