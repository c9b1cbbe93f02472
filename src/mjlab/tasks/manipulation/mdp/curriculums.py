"""Module that packages of releases 1.1 and 1.2 import; curricula are in `mjlab.envs.mdp`."""

from mjlab.compat import older_names

__getattr__ = older_names(__name__)
