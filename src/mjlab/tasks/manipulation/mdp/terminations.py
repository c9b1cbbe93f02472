"""Public path of the termination terms of the manipulation tasks."""

from mjlab.compat import older_names
from mjlab.envs.mdp.terminations import illegal_contact

__all__ = ["illegal_contact"]

__getattr__ = older_names(__name__)
