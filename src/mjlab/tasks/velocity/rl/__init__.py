"""Runner and learner configs of the velocity task."""

from mjlab.tasks.velocity.rl.runner import VelocityOnPolicyRunner as VelocityOnPolicyRunner
