"""The runner of tasks whose policies are deployed."""

from __future__ import annotations

from mjlab.rl.runner import MjlabOnPolicyRunner


class ExportingOnPolicyRunner(MjlabOnPolicyRunner):
    """Trains as `MjlabOnPolicyRunner` does, and exports the policy whenever it saves."""

    exports_on_save = True

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint, and the policy where `_get_export_paths` says.

        The ONNX file carries what a deployment needs to know. An export that fails is logged, and
        training goes on.

        Args:
            path: Where to write the checkpoint.
            infos: Further plain data, which `load` returns.

        Raises:
            CheckpointError: the checkpoint could not be written.
        """
        super().save(path, infos)
        if self._writes:
            self.export_policy(str(self._get_export_paths(path)[2]))
