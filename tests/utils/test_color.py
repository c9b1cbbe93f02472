"""Colors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjlab.utils.color import (
    HSV,
    RGB,
    RGBA,
    adjust_saturation,
    brand_ramp,
    clamp,
    darken_rgba,
    hsv_to_rgb,
    lighten_rgba,
    rgb_to_hsv,
)

unit = st.floats(0, 1)
rgbs = st.tuples(unit, unit, unit)


@settings(deadline=None)
@given(rgbs)
def test_hsv_survives_a_round_trip(rgb):
    assert hsv_to_rgb(rgb_to_hsv(rgb)) == pytest.approx(rgb, abs=1e-9)


@settings(deadline=None)
@given(rgbs, st.floats(0, 3))
def test_saturation_changes_alone(rgb, factor):
    before, after = rgb_to_hsv(rgb), rgb_to_hsv(adjust_saturation(rgb, factor))
    assert after.v == pytest.approx(before.v)
    assert after.s == pytest.approx(min(1.0, before.s * factor), abs=1e-6)


@settings(deadline=None)
@given(rgbs, unit, unit)
def test_darker_and_lighter_colors_keep_their_opacity(rgb, alpha, factor):
    rgba = (*rgb, alpha)
    dark, light = darken_rgba(rgba, factor), lighten_rgba(rgba, factor)
    assert dark[3] == light[3] == alpha
    assert dark[:3] == pytest.approx([c * factor for c in rgb])
    assert light[:3] == pytest.approx([c + (1 - c) * factor for c in rgb])


@settings(deadline=None)
@given(unit, unit)
def test_a_ramp_keeps_the_hue(t, alpha):
    blue = (0.20, 0.45, 0.95)
    base = rgb_to_hsv(blue)
    *rgb, opacity = brand_ramp(blue, t, alpha)
    hue, saturation, value = rgb_to_hsv((rgb[0], rgb[1], rgb[2]))
    assert opacity == alpha
    assert hue == pytest.approx(base.h)
    assert saturation == pytest.approx(min(1.0, base.s * (0.85 + 0.25 * t)))
    assert value == pytest.approx(0.75 + 0.25 * t)


@pytest.mark.parametrize("t", [-0.1, 1.1])
def test_a_ramp_ends(t):
    with pytest.raises(ValueError, match="t: "):
        brand_ramp((1, 0, 0), t)


def test_random_colors_repeat_with_their_generator():
    first = RGBA.random(np.random.default_rng(1), alpha=0.5)
    rgb = RGB.random(np.random.default_rng(1))
    assert first == RGBA.from_rgb(rgb, 0.5)
    assert rgb.to_tuple() == (rgb.r, rgb.g, rgb.b)
    assert all(0 <= c <= 1 for c in rgb)
    assert HSV(0.1, 0.2, 0.3).s == 0.2


def test_clamp():
    assert [clamp(v) for v in (-1.0, 0.5, 2.0)] == [0.0, 0.5, 1.0]
    assert clamp(5.0, 2.0, 3.0) == 3.0
