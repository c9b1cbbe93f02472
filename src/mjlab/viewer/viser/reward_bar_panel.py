"""Bar chart of reward terms."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Sequence

import viser

from mjlab.utils.string import escaped
from mjlab.viewer.base import TermHistory

log = logging.getLogger(__name__)

_WINDOW_S = 1.0
_POSITIVE, _NEGATIVE = "#2f9e44", "#e03131"


class RewardBarPanel:
    """Sum of the reward, and one bar per term: means over the last second.

    The longest bar is the largest magnitude. Green: positive, red: negative.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        term_names: list[str],
        update_dt: float,
        max_terms: int = 20,
        is_shown: Callable[[str], bool] = lambda name: True,
    ) -> None:
        """Add the panel to the current GUI container.

        Args:
            server: The page's server.
            term_names: Names of the reward terms.
            update_dt: Time between two calls of `update` (s).
            max_terms: Maximum number of terms shown. More terms log a warning.
            is_shown: Function of the name; False hides a term, for example one of weight zero.
        """
        shown = [name for name in term_names if is_shown(name)]
        if len(shown) > max_terms:
            log.warning(
                "The reward has %d terms and bars show the first %d; increase "
                "viewer.reward_bar_max_terms to see more.",
                len(shown),
                max_terms,
            )
        self._max_terms, self._is_shown = max_terms, is_shown
        self._names = term_names
        self._history = TermHistory(max(1, round(_WINDOW_S / update_dt)))
        self._html = server.gui.add_html("")
        self.refresh()

    def update(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Record a value per term and show the means."""
        self.add(terms)
        self.refresh()

    def add(self, terms: Iterable[tuple[str, Sequence[float]]]) -> None:
        """Record a value per term; the next `refresh` shows it."""
        self._history.add(terms)

    def refresh(self) -> None:
        """Show the means of the recorded values."""
        means = {name: self._history.mean(name) for name in self._names if self._is_shown(name)}
        total = sum(means.values())
        means = dict(itertools.islice(means.items(), self._max_terms))
        largest = max((abs(value) for value in means.values()), default=0.0) or 1.0
        rows = "".join(_row(name, value, largest) for name, value in means.items())
        self._html.content = (
            '<div style="padding:0.25em 1em;font-size:0.8em">'
            f"<div><strong>Mean of the last {self._history.length} steps</strong></div>"
            '<div style="display:flex;justify-content:space-between"><span>sum</span>'
            f"<strong>{total:+.4f}</strong></div>{rows}</div>"
        )

    def clear_histories(self) -> None:
        """Clear the recorded values."""
        self._history.clear()

    def cleanup(self) -> None:
        """Remove the panel from the page."""
        self._html.remove()


def _row(name: str, value: float, largest: float) -> str:
    color = _NEGATIVE if value < 0 else _POSITIVE
    width = 100.0 * abs(value) / largest
    return (
        '<div style="margin-top:0.35em">'
        '<div style="display:flex;justify-content:space-between;gap:0.5em">'
        f'<span style="overflow-wrap:anywhere">{escaped(name)}</span>'
        f"<span>{value:+.4f}</span></div>"
        '<div style="background:rgba(128,128,128,0.2);border-radius:2px">'
        f'<div style="width:{width:.1f}%;height:6px;background:{color};border-radius:2px">'
        "</div></div></div>"
    )
