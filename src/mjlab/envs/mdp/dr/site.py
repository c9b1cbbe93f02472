"""Randomization of sites."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import SITE, field_term, rotation_term
from mjlab.managers.event_manager import RecomputeLevel

__all__ = ["site_pos", "site_quat"]

# Spatial tendons pass through sites, and actuators act at sites.
site_pos = field_term(
    __name__,
    "site_pos",
    SITE,
    "Randomize site positions x, y, z (m) in the body frame.",
    recompute=RecomputeLevel.set_const_0,
)
site_quat = rotation_term(
    __name__,
    "site_quat",
    SITE,
    "Perturb site orientations in the body frame.",
    recompute=RecomputeLevel.set_const_0,
)
