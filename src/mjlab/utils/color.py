"""Colors, as tuples of numbers in [0, 1]."""

from __future__ import annotations

import colorsys
from typing import NamedTuple

import numpy as np

from mjlab.utils.errors import check_in_range


class RGB(NamedTuple):
    """Red, green and blue."""

    r: float
    g: float
    b: float

    @staticmethod
    def random(rng: np.random.Generator) -> RGB:
        """Return a color with uniform random components."""
        return RGB(*(float(value) for value in rng.random(3)))

    def to_tuple(self) -> tuple[float, float, float]:
        """Return the color as a plain tuple."""
        return (self.r, self.g, self.b)


class HSV(NamedTuple):
    """Hue, saturation and value."""

    h: float
    s: float
    v: float


class RGBA(NamedTuple):
    """Red, green, blue and opacity."""

    r: float
    g: float
    b: float
    a: float

    @classmethod
    def from_rgb(cls, rgb: RGB, alpha: float = 1.0) -> RGBA:
        """Return `rgb` with opacity `alpha`."""
        return cls(*rgb, alpha)

    @staticmethod
    def random(rng: np.random.Generator, alpha: float = 1.0) -> RGBA:
        """Return a color with uniform random components and opacity `alpha`."""
        return RGBA.from_rgb(RGB.random(rng), alpha)


def clamp(value: float, min_val: float = 0.0, max_val: float = 1.0) -> float:
    """Return `value` limited to [min_val, max_val]."""
    return max(min_val, min(value, max_val))


def rgb_to_hsv(rgb: tuple[float, float, float]) -> HSV:
    """Convert RGB to HSV; the hue is in [0, 1]."""
    return HSV(*colorsys.rgb_to_hsv(*rgb))


def hsv_to_rgb(hsv: HSV) -> tuple[float, float, float]:
    """Convert HSV to RGB; the hue is in [0, 1]."""
    return colorsys.hsv_to_rgb(*hsv)


def adjust_saturation(rgb: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    """Multiply the saturation by `factor` and clamp it to [0, 1]."""
    hue, saturation, value = rgb_to_hsv(rgb)
    return hsv_to_rgb(HSV(hue, clamp(saturation * factor), value))


def darken_rgba(
    rgba: tuple[float, float, float, float], factor: float = 0.85
) -> tuple[float, float, float, float]:
    """Multiply red, green and blue by `factor`."""
    r, g, b, a = rgba
    return (clamp(r * factor), clamp(g * factor), clamp(b * factor), a)


def lighten_rgba(
    rgba: tuple[float, float, float, float], factor: float = 0.15
) -> tuple[float, float, float, float]:
    """Interpolate red, green and blue toward white by the fraction `factor`."""
    r, g, b, a = rgba
    return (
        clamp(r + (1.0 - r) * factor),
        clamp(g + (1.0 - g) * factor),
        clamp(b + (1.0 - b) * factor),
        a,
    )


def brand_ramp(
    base_rgb: tuple[float, float, float], t: float, alpha: float = 1.0
) -> tuple[float, float, float, float]:
    """Return a shade of the base color, from dull and dark (t = 0) to vivid and bright (t = 1).

    The hue is unchanged; value = 0.75 + 0.25 t, saturation = s (0.85 + 0.25 t), at most 1. Raises
    `ValueError` for t outside [0, 1].
    """
    check_in_range("t", t, 0.0, 1.0)
    hue, saturation, _ = rgb_to_hsv(base_rgb)
    shade = HSV(hue, clamp(saturation * (0.85 + 0.25 * t)), 0.75 + 0.25 * t)
    return (*hsv_to_rgb(shade), alpha)
