"""Parts of pages: ticks, charts and escaping."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjlab.utils.page import Line, chart, facts, listed, sparkline, ticks

NAN = float("nan")


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_ticks_are_few_and_within(low, span):
    found = ticks(low, low + span)
    assert 2 <= len(found) <= 7
    assert all(low - 1e-3 * span <= one <= low + (1.0 + 1e-3) * span for one in found)


def test_ticks_are_round():
    assert ticks(0.0, 1.0) == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert ticks(-31.0, 12.0) == [-30.0, -20.0, -10.0, 0.0, 10.0]


@pytest.mark.parametrize("values", [[1.0], [2.0, 2.0], [0.0, NAN, 3.0], [NAN, 1.0, math.inf]])
def test_charts_have_finite_coordinates(values):
    line = Line("v", list(range(len(values))), values, has_marks=True)
    for drawing in (chart("t", [line], rules=(0.0,), has_cursor=True), sparkline(line.x, line.y)):
        svg = ElementTree.fromstring(re.search("<svg.*</svg>", drawing)[0])
        assert not re.search(r"nan|inf", ElementTree.tostring(svg, "unicode"))


def test_missing_values_break_a_line():
    (path,) = re.findall(
        r'd="(M[^"]*)" stroke', chart("t", [Line("", range(4), [1.0, 2.0, NAN, 3.0])])
    )
    assert (path.count("M"), path.count("L")) == (2, 1)


def test_names_are_shown_as_they_are():
    hostile = "<script>"
    line = Line(hostile, [0.0, 1.0], [0.0, 1.0])
    drawn = chart(hostile, [line], x_label=hostile)
    for text in (facts({hostile: hostile}), listed([hostile]), drawn):
        assert hostile not in text
