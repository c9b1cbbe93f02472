"""Curriculum terms of the manipulation tasks, all of which are in `mjlab.envs.mdp` today."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
