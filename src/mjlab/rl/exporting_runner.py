"""The runner of tasks whose policies are deployed."""

from __future__ import annotations

from pathlib import Path

from mjlab.rl.runner import MjlabOnPolicyRunner


class ExportingOnPolicyRunner(MjlabOnPolicyRunner):
    """Trains as `MjlabOnPolicyRunner` does, and exports the policy whenever it saves."""

    exports_on_save = True

    def save(self, path: str, infos=None) -> None:
        """Write a checkpoint, and the policy as `<folder>/<folder's name>.onnx` beside it.

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
            folder = Path(path).resolve().parent
            self.export_policy(str(folder / f"{folder.name}.onnx"))
