"""Randomization of lights."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import LIGHT, field_term

__all__ = [
    "light_ambient",
    "light_attenuation",
    "light_cutoff",
    "light_diffuse",
    "light_dir",
    "light_exponent",
    "light_pos",
    "light_specular",
]

light_ambient = field_term(__name__, "light_ambient", LIGHT, "Randomize ambient colors r, g, b.")
light_attenuation = field_term(
    __name__,
    "light_attenuation",
    LIGHT,
    "Randomize attenuation: constant, linear and quadratic coefficient.",
)
light_cutoff = field_term(__name__, "light_cutoff", LIGHT, "Randomize spotlight cutoffs (degrees).")
light_diffuse = field_term(__name__, "light_diffuse", LIGHT, "Randomize diffuse colors r, g, b.")
light_dir = field_term(
    __name__,
    "light_dir",
    LIGHT,
    "Randomize light directions x, y, z (body frame), normalized to length 1. Axes without "
    "ranges start from the default direction.",
    unit=True,
)
light_exponent = field_term(__name__, "light_exponent", LIGHT, "Randomize spotlight exponents.")
light_pos = field_term(
    __name__, "light_pos", LIGHT, "Randomize light positions x, y, z (m), body frame."
)
light_specular = field_term(__name__, "light_specular", LIGHT, "Randomize specular colors r, g, b.")
