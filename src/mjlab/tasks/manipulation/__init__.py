"""Manipulation tasks: an arm lifts a cube to a goal, from state or camera observations."""

# Register the tasks by name, so that nothing heavy is imported.
from mjlab.tasks.manipulation.config import yam as _yam  # noqa: F401
