"""Public path of the runner of the velocity task."""

from mjlab.rl.runner import ExportingOnPolicyRunner


class VelocityOnPolicyRunner(ExportingOnPolicyRunner):
    """`MjlabOnPolicyRunner` that exports the policy with each checkpoint."""
