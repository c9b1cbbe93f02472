"""Runner and learner configs of the velocity task."""

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.velocity.rl.runner import VelocityOnPolicyRunner as VelocityOnPolicyRunner

# Imported on first use: learner configs, read for `--help`, do not need rsl_rl.
__getattr__ = lazy_names(__name__, {"VelocityOnPolicyRunner": "mjlab.tasks.velocity.rl.runner"})
