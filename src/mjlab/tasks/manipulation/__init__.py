"""Manipulation: an arm lifts a cube to a goal, from the state or from what its camera sees."""

# Registers its tasks, by name, so that nothing heavy is imported.
from mjlab.tasks.manipulation.config import yam as _yam  # noqa: F401
