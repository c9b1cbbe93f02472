"""The runner of the manipulation tasks."""

from mjlab.rl.runner import ExportingOnPolicyRunner


class ManipulationOnPolicyRunner(ExportingOnPolicyRunner):
    """Trains as `MjlabOnPolicyRunner` does, and exports the policy whenever it saves."""
