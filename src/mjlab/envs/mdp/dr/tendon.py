"""Randomization of tendons."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import TENDON, field_term
from mjlab.managers.event_manager import RecomputeLevel

__all__ = [
    "tendon_armature",
    "tendon_damping",
    "tendon_friction",
    "tendon_frictionloss",
    "tendon_stiffness",
]

tendon_armature = field_term(
    __name__,
    "tendon_armature",
    TENDON,
    "Randomize tendon armature (kg).",
    recompute=RecomputeLevel.set_const_0,
)
tendon_damping = field_term(__name__, "tendon_damping", TENDON, "Randomize tendon damping (N s/m).")
tendon_friction = tendon_frictionloss = field_term(
    __name__,
    "tendon_friction",
    TENDON,
    "Randomize dry tendon friction (N).",
    field="tendon_frictionloss",
)
tendon_stiffness = field_term(
    __name__, "tendon_stiffness", TENDON, "Randomize tendon stiffness (N/m)."
)
