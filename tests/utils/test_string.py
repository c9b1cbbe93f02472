"""Lenient matching of names."""

from __future__ import annotations

import html
import logging
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.string import counted, escaped, filter_exp, resolve_expr, resolve_field

NAMES = ("hip_a", "hip_b", "knee")


def test_the_first_matching_pattern_counts():
    assert resolve_expr({"hip": 1, "hip_b": 2}, NAMES, 0) == (1, 1, 0)
    assert resolve_expr({"hip_b": 2, "hip": 1}, NAMES, 0) == (1, 2, 0)


def test_names_without_a_pattern_get_the_default():
    assert resolve_expr({"knee": 5}, NAMES) == (None, None, 5)


@pytest.mark.parametrize("match", [resolve_expr, filter_exp])
def test_a_pattern_that_matches_nothing_is_reported(caplog, match):
    with caplog.at_level(logging.WARNING):
        match({"hip": 1, "ankle": 2}, NAMES)
    assert "'ankle'" in caplog.text
    assert "'hip'" not in caplog.text.split("match none")[0]
    assert "hip_a" in caplog.text


@pytest.mark.parametrize("match", [resolve_expr, filter_exp])
def test_long_reports_list_near_names_and_a_count(caplog, match):
    names = (*(f"box_{i}" for i in range(2171)), "pillar")
    match({"piller": 1}, names)
    assert caplog.messages == [
        "Patterns ['piller'] match none of the names ['pillar'] and 2171 others."
    ]
    caplog.clear()
    match({"xyz": 1}, names)
    assert "['box_0', 'box_1', 'box_2'] and 2169 others." in caplog.text


@pytest.mark.parametrize(
    ("patterns", "names"), [({".*": 0.0}, ()), ({"hip_a": 1, "hip.*": 2, ".*": 3}, NAMES)]
)
def test_nothing_is_reported_without_reason(caplog, patterns, names):
    resolve_expr(patterns, names)
    assert not caplog.records


def test_a_scalar_field_is_repeated_and_a_dict_resolved():
    assert resolve_field((1, 2), NAMES) == ((1, 2),) * 3
    assert resolve_field({"knee": 4}, NAMES, 7) == (7, 7, 4)


def test_filter_keeps_name_order_and_duplicates():
    assert filter_exp(("knee", "hip"), ("hip", "x", "knee", "hip")) == ("hip", "knee", "hip")


def test_an_invalid_pattern_is_quoted():
    with pytest.raises(ValueError, match=r"'\(hip' is not a valid regular expression"):
        resolve_expr({"(hip": 1}, NAMES)


@settings(deadline=None)
@given(st.lists(st.text("ab_", max_size=4), max_size=6), st.lists(st.text("ab.", max_size=3)))
def test_filter_and_resolve_agree_on_what_is_matched(names, patterns):
    names = tuple(names)
    resolved = resolve_expr(dict.fromkeys(patterns, True), names, False)
    chosen = tuple(name for name, hit in zip(names, resolved, strict=True) if hit)
    assert filter_exp(patterns, names) == chosen


def test_one_of_a_kind_is_singular():
    assert [counted(n, "environment") for n in (0, 1, 2)] == [
        "0 environments", "1 environment", "2 environments",
    ]  # fmt: skip


HOSTILE = [
    '<iframe srcdoc="<script>">', "<img src=x onerror=f()>", "`</code><i>`", "[a](javascript:f())",
    "a\n\n<b>", "a|b", "{x}", "left_hip*", "_a_", "__init__", "&lt;b&gt;", "\\*", "$x$", "~~s~~",
    "<https://a.b>", "www.a.b<x>", "a@b.c", "\ud800", "\0", "'\"", "!--", "]]>",
]  # fmt: skip


@pytest.mark.parametrize("text", HOSTILE)
def test_escaped_text_is_shown_as_it_is(text):
    shown = escaped(text)
    assert not set(shown) & set("<>\"'`[]{}|\\*~!$@^\n\0\ud800")
    assert not re.search(r"&(?!#?\w+;)|\b_|_\b|://|www\.", shown)
    # Python and browsers replace what is no character.
    assert html.unescape(shown) == re.sub("[\ud800\0]", "\ufffd", text)


@pytest.mark.parametrize("text", ["left_hip_2", "FR.calf-1 (rad)", "Größe: 0.5, 10 %", "a/b c"])
def test_ordinary_names_are_left_as_they_are(text):
    assert escaped(text) == text
