"""Randomization of sites."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import field_term, rotation_term

site_pos = field_term("site_pos")
site_quat = rotation_term("site_quat")
