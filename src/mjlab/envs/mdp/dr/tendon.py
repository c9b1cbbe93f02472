"""Randomization of tendons."""

from __future__ import annotations

from mjlab.envs.mdp.dr._core import field_term

tendon_armature = field_term("tendon_armature")
tendon_damping = field_term("tendon_damping")
tendon_friction = field_term("tendon_friction")
tendon_stiffness = field_term("tendon_stiffness")

# MuJoCo's own names of the fields.
tendon_frictionloss = tendon_friction
