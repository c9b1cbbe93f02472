"""Velocity: a legged robot walks and turns as commanded, on flat ground or on rough terrain."""

# Each registers its tasks, by name, so that nothing heavy is imported.
from mjlab.tasks.velocity.config import g1 as _g1  # noqa: F401
from mjlab.tasks.velocity.config import go1 as _go1  # noqa: F401
