"""Public path of the runner of the manipulation tasks."""

from mjlab.rl.runner import ExportingOnPolicyRunner


class ManipulationOnPolicyRunner(ExportingOnPolicyRunner):
    """`MjlabOnPolicyRunner` that exports the policy with every checkpoint."""
