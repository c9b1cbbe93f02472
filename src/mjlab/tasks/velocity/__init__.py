"""Velocity tasks: legged robots track velocity commands on flat ground and rough terrain."""

# Robot packages register tasks by name, so torch and MuJoCo are not imported.
from mjlab.tasks.velocity.config import g1 as _g1  # noqa: F401
from mjlab.tasks.velocity.config import go1 as _go1  # noqa: F401
