"""Curriculum terms of the manipulation tasks, now in `mjlab.envs.mdp`."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
