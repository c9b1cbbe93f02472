"""Source of names, patterns and numbers."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjlab.own_robot.python_text import dict_source, number, pattern, tuple_source

NAMES = st.lists(st.text("abLR_-.", min_size=1, max_size=6), min_size=1, max_size=8, unique=True)


@given(NAMES, st.data())
def test_pattern_matches_its_names_only(among: list[str], data) -> None:
    chosen = data.draw(st.lists(st.sampled_from(among), min_size=1, unique=True))
    expression = pattern(chosen, among)
    assert {name for name in among if re.fullmatch(expression, name)} == set(chosen)
    assert {name for name in among if re.match(expression, name)} == set(chosen)


def test_pattern_has_the_common_end() -> None:
    among = ["left_hip", "left_knee", "right_hip", "right_knee"]
    assert pattern(["left_knee", "right_knee"], among) == ".*_knee"
    assert pattern(among, among) == ".*"


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_number_has_four_digits(value: float) -> None:
    assert float(number(value)) == pytest.approx(value, rel=1e-3)


@given(st.dictionaries(st.text(max_size=5), st.floats(0, 1)), st.lists(st.text(max_size=40)))
def test_source_is_read_back(values: dict[str, float], items: list[str]) -> None:
    read = eval(dict_source(values, dict.fromkeys(values, "reason " * 20)))
    assert read == {key: float(number(value)) for key, value in values.items()}
    assert eval(tuple_source(items)) == tuple(items)
