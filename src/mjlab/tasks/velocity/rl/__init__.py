"""Training of the velocity task."""

from mjlab.tasks.velocity.rl.runner import VelocityOnPolicyRunner as VelocityOnPolicyRunner
