"""Runner of the motion tracking tasks."""

from mjlab.tasks.tracking.rl.runner import (
    MotionTrackingOnPolicyRunner as MotionTrackingOnPolicyRunner,
)
