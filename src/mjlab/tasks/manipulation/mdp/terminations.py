"""Termination terms of the manipulation tasks. Each returns bool (N,)."""

# A hand that hits the ground is what a knee is that does.
from mjlab.tasks.velocity.mdp.terminations import illegal_contact as illegal_contact
