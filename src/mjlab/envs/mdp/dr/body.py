"""Randomization of bodies."""

from __future__ import annotations

from mjlab.compat import older_names
from mjlab.envs.mdp.dr._terms import field_term, rotation_term
from mjlab.envs.mdp.dr.inertia import pseudo_inertia

__all__ = [
    "body_com_offset",
    "body_ipos",
    "body_mass",
    "body_pos",
    "body_quat",
    "pseudo_inertia",
]

body_com_offset = field_term("body_com_offset")
body_mass = field_term("body_mass")
body_pos = field_term("body_pos")
body_quat = rotation_term("body_quat")

# MuJoCo's own name of the field.
body_ipos = body_com_offset


__getattr__ = older_names(__name__)
