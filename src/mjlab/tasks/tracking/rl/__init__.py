"""Runner of the motion tracking tasks."""

from typing import TYPE_CHECKING

from mjlab.utils.lazy import lazy_names

if TYPE_CHECKING:
    from mjlab.tasks.tracking.rl.runner import (
        MotionTrackingOnPolicyRunner as MotionTrackingOnPolicyRunner,
    )

# Imported on first use: learner configs, read for `--help`, do not need rsl_rl.
__getattr__ = lazy_names(
    __name__, {"MotionTrackingOnPolicyRunner": "mjlab.tasks.tracking.rl.runner"}
)
