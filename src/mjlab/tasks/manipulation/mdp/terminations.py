"""Termination terms of the manipulation tasks. Each returns bool (N,)."""

from mjlab.envs.mdp.terminations import illegal_contact as illegal_contact
