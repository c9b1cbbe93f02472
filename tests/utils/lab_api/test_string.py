"""Strict matching of names, and conversions to and from strings."""

from __future__ import annotations

import re

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mjlab.utils.lab_api.string import (
    callable_to_string,
    is_lambda_expression,
    resolve_matching_names,
    resolve_matching_names_values,
    string_to_callable,
    string_to_slice,
    to_camel_case,
    to_snake_case,
)

NAMES = ["FL_hip", "FR_hip", "FL_knee", "FR_knee"]


def test_a_pattern_must_match_the_whole_name():
    assert resolve_matching_names("FL_.*", NAMES) == ([0, 2], ["FL_hip", "FL_knee"])
    with pytest.raises(ValueError, match="match no name"):
        resolve_matching_names("FL", NAMES)


def test_order_is_that_of_the_names_or_of_the_patterns():
    keys = [".*_knee", ".*_hip"]
    assert resolve_matching_names(keys, NAMES)[0] == [0, 1, 2, 3]
    assert resolve_matching_names(keys, NAMES, preserve_order=True)[0] == [2, 3, 0, 1]


def test_no_patterns_select_nothing():
    assert resolve_matching_names((), NAMES) == ([], [])


def test_an_unmatched_pattern_is_an_error_that_lists_matches_and_names():
    with pytest.raises(ValueError) as error:
        resolve_matching_names([".*_hip", ".*_ankle"], NAMES)
    message = str(error.value)
    assert "['.*_ankle']" in message
    assert "'.*_hip': ['FL_hip', 'FR_hip']" in message
    assert str(NAMES) in message


def test_a_name_that_two_patterns_match_is_an_error():
    with pytest.raises(ValueError, match=r"'FL_hip' is matched by several patterns") as error:
        resolve_matching_names([".*", "FL_.*"], NAMES)
    assert "'FL_.*': ['FL_hip', 'FL_knee']" in str(error.value)


def test_values_follow_their_names():
    data = {".*_knee": "k", "F._hip": "h"}
    indices, names, values = resolve_matching_names_values(data, NAMES, preserve_order=True)
    assert (indices, values) == ([2, 3, 0, 1], ["k", "k", "h", "h"])
    assert names == [NAMES[i] for i in indices]
    assert resolve_matching_names_values(data, NAMES)[2] == ["h", "h", "k", "k"]


def test_values_must_come_in_a_dict():
    with pytest.raises(TypeError, match="list"):
        resolve_matching_names_values([".*"], NAMES)  # ty: ignore[invalid-argument-type]


@settings(deadline=None)
@given(
    st.lists(st.text("ab", min_size=1, max_size=3), unique=True, min_size=1),
    st.lists(st.text("ab.", min_size=1, max_size=3), min_size=1, max_size=3),
)
def test_matching_agrees_with_its_definition(names, keys):
    hits = {key: [n for n in names if re.fullmatch(key, n)] for key in keys}
    counts = {n: sum(bool(re.fullmatch(key, n)) for key in keys) for n in names}
    if not all(hits.values()) or max(counts.values()) > 1:
        with pytest.raises(ValueError):
            resolve_matching_names(keys, names)
        return
    indices, found = resolve_matching_names(keys, names)
    assert indices == [i for i, n in enumerate(names) if counts[n]]
    grouped = resolve_matching_names(keys, names, preserve_order=True)[1]
    assert grouped == [n for key in keys for n in hits[key]]
    assert sorted(found) == sorted(grouped)


@settings(deadline=None)
@given(st.lists(st.text("abc", min_size=1, max_size=5), min_size=1, max_size=4))
def test_snake_case_survives_a_round_trip(words):
    assume(all(len(word) > 1 for word in words))
    snake = "_".join(words)
    assert to_snake_case(to_camel_case(snake)) == snake
    assert to_snake_case(to_camel_case(snake, "CC")) == snake


def test_camel_case_kinds():
    assert to_camel_case("joint_pos_limits") == "jointPosLimits"
    assert to_camel_case("joint_pos_limits", "CC") == "JointPosLimits"
    assert to_snake_case("RslRlVecEnvWrapper") == "rsl_rl_vec_env_wrapper"
    with pytest.raises(ValueError, match="'cC'"):
        to_camel_case("a", "xx")


ints = st.none() | st.integers(-9, 9)


@settings(deadline=None)
@given(st.builds(slice, ints, ints, ints))
def test_slices_survive_a_round_trip(value):
    assert string_to_slice(str(value)) == value


@pytest.mark.parametrize("text", ["1:2", "slice()", "slice(a)", "slice(1,2,3,4)", ""])
def test_other_text_is_no_slice(text):
    with pytest.raises(ValueError, match="Expected a slice"):
        string_to_slice(text)


def test_callables_survive_a_round_trip():
    for value in (resolve_matching_names, re.compile, str.upper, dict.fromkeys):
        assert string_to_callable(callable_to_string(value)) == value
    assert callable_to_string(re.compile) == "re:compile"


def test_lambdas_survive_a_round_trip():
    double = lambda x: 2 * x  # noqa: E731
    text = callable_to_string(double)
    assert is_lambda_expression(text)
    assert string_to_callable(text)(21) == 42
    assert not is_lambda_expression("re:compile")


@pytest.mark.parametrize("text", ["re", "re:", "no_such_module:x", "re:no_such", "re:I.value.real"])
def test_text_that_names_no_callable_is_refused(text):
    with pytest.raises(ValueError, match=re.escape(repr(text))):
        string_to_callable(text)


def test_what_is_not_callable_has_no_name():
    with pytest.raises(ValueError, match="int: 3"):
        callable_to_string(3)  # ty: ignore[invalid-argument-type]
