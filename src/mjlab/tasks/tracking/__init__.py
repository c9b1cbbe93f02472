"""Motion tracking tasks: a robot imitates reference motions."""

# Register the tasks by name, so that nothing heavy is imported.
from mjlab.tasks.tracking.config import g1 as _g1  # noqa: F401
