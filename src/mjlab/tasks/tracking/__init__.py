"""Motion tracking: a robot moves as a recording does."""

# Registers its tasks, by name, so that nothing heavy is imported.
from mjlab.tasks.tracking.config import g1 as _g1  # noqa: F401
