"""Recent values of terms."""

from __future__ import annotations

import numpy as np

from mjlab.viewer.base import TermHistory


def test_only_the_latest_points_are_kept_and_averaged_over_finite_ones() -> None:
    history = TermHistory(length=4)
    for value in (1.0, 2.0, float("inf"), 4.0, 6.0):
        history.add([("a", [value])])
    np.testing.assert_array_equal(history.values("a"), [2.0, np.nan, 4.0, 6.0])
    assert history.mean("a") == 4.0
    history.clear()
    assert history.names == ["a"]
    assert history.mean("a") == 0.0
    assert len(history.values("unknown")) == 0
