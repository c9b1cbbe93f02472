"""Randomization of lights."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import field_term

light_ambient = field_term("light_ambient")
light_attenuation = field_term("light_attenuation")
light_cutoff = field_term("light_cutoff")
light_diffuse = field_term("light_diffuse")
light_dir = field_term("light_dir")
light_exponent = field_term("light_exponent")
light_pos = field_term("light_pos")
light_specular = field_term("light_specular")
