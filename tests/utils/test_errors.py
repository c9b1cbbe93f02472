import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjlab.utils import errors
from mjlab.utils.errors import (
    MjlabError,
    UnknownNameError,
    check_count,
    check_exists,
    check_fields_positive,
    check_in_range,
    check_one_of,
    check_positive,
)

CLASSES = [
    (errors.UnknownNameError, KeyError),
    (errors.UnknownAttributeError, AttributeError),
    (errors.WrongTypeError, TypeError),
    (errors.WrongStateError, RuntimeError),
    (errors.UnsupportedError, NotImplementedError),
]


@pytest.mark.parametrize(("kind", "builtin"), CLASSES)
def test_errors_are_caught_by_their_builtin_and_by_the_base(kind, builtin):
    error = pickle.loads(pickle.dumps(kind("wrong 'x'")))
    assert isinstance(error, builtin)
    assert isinstance(error, MjlabError)
    assert str(error) == "wrong 'x'"


@given(st.floats(), st.floats(-10, 0), st.floats(0, 10))
def test_ranges_hold_exactly_their_values(value, low, high):
    for allowed, check, bounds in (
        (value > 0, check_positive, ()),
        (low <= value <= high, check_in_range, (low, high)),
    ):
        if allowed:
            check("gain", value, *bounds)
            continue
        with pytest.raises(ValueError, match="gain") as raised:
            check("gain", value, *bounds)
        assert str(value) in str(raised.value)


@pytest.mark.parametrize("value", [0, -1, 2.0, False, "3", None])
def test_counts_are_integers_from_the_minimum_up(value):
    with pytest.raises(ValueError, match="num_envs"):
        check_count("num_envs", value)
    check_count("num_envs", 1)
    check_count("num_envs", np.int64(1))


def test_choices_and_names():
    check_one_of("mode", "add", ("add", "scale"))
    with pytest.raises(ValueError, match="scale"):
        check_one_of("mode", "ad", ("add", "scale"))
    check_exists("entity", "robot", ["robot"])
    with pytest.raises(UnknownNameError, match="'robott'.*'robot'"):
        check_exists("entity", "robott", ["robot", "cube"], UnknownNameError)


@given(st.floats())
def test_checks_of_fields_name_class_field_and_value(height):
    cfg = SimpleNamespace(height=height)
    if 0.0 < height < np.inf:
        check_fields_positive(cfg, "height")
        return
    with pytest.raises(ValueError, match="SimpleNamespace.height: ") as raised:
        check_fields_positive(cfg, "height")
    assert repr(height) in str(raised.value)
