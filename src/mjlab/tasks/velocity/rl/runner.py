"""The runner of the velocity task."""

from mjlab.rl.runner import ExportingOnPolicyRunner


class VelocityOnPolicyRunner(ExportingOnPolicyRunner):
    """Trains as `MjlabOnPolicyRunner` does, and exports the policy whenever it saves."""
