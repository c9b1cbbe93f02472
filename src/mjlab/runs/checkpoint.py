"""Checkpoints: weights and state of a run in one file, read when first needed, and once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.utils.os import checkpoint_number

if TYPE_CHECKING:
    from mjlab.rl.learners import Learner

_NETWORKS = ("actor", "critic", "student", "teacher")


class Checkpoint:
    """Checkpoint of a run. It is `os.PathLike`: functions that take a path take it as well."""

    def __init__(self, path: Path | str) -> None:
        """Set the path; the file is not read."""
        self.path = Path(path)
        """File."""

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    def __repr__(self) -> str:
        return f"Checkpoint({str(self.path)!r})"

    @cached_property
    def content(self) -> dict[str, Any]:
        """Content of the file, in the current layout.

        Raises:
            CheckpointError: the file is missing, damaged or hostile.
        """
        # Imports torch.
        from mjlab.rl.checkpoint import load_checkpoint, migrate

        return migrate(load_checkpoint(self.path))

    @property
    def number(self) -> int | None:
        """Number in the name of the file: the last finished iteration, from 0; None for other names."""
        return checkpoint_number(self.path.name)

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return self.content.get("iterations_finished", self.content.get("iter", -1) + 1)

    @property
    def learner(self) -> Learner:
        """Learner that wrote the file."""
        if "student_state_dict" in self.content:
            return "distillation"
        return "sac" if "sac_state_dict" in self.content else "ppo"

    @property
    def weights(self) -> dict[str, Mapping[str, Any]]:
        """State dict of each network (`actor`, `critic`, ...)."""
        found = {name: self.content.get(f"{name}_state_dict") for name in _NETWORKS}
        return {name: state for name, state in found.items() if state is not None}

    @property
    def task(self) -> str | None:
        """Task; None in files of earlier versions."""
        return self._text("task")

    @property
    def identity(self) -> str | None:
        """Token shared by the file and its replay; None in files of earlier versions."""
        return self._text("identity")

    @property
    def sizes(self) -> dict[str, Any]:
        """Terms and their shapes, in order, of each network and of `actions`; empty if unknown."""
        return self.content.get("sizes") or {}

    @property
    def num_envs(self) -> int | None:
        """Number of environments per process; None in files without training state."""
        count = (self.content.get("training_state") or {}).get("num_envs")
        return count if isinstance(count, int) else None

    def _text(self, name: str) -> str | None:
        value = self.content.get(name)
        return value if isinstance(value, str) else None

    def load_into(
        self, runner: Any, load_cfg: dict[str, bool] | None = None, device: str | None = None
    ) -> None:
        """Load the file into `runner`, as `runner.load` does.

        Runners with a method `load` of their own read the file by themselves.

        Args:
            runner: Runner.
            load_cfg: Parts to load. None: all.
            device: Device for runners that do not move tensors to that of their networks.
        """
        from mjlab.rl import MjlabOnPolicyRunner

        if (
            isinstance(runner, MjlabOnPolicyRunner)
            and type(runner).load is MjlabOnPolicyRunner.load
        ):
            runner.load_content(self.content, self.path, load_cfg=load_cfg)
        elif load_cfg is None:
            runner.load(str(self.path))
        else:
            runner.load(str(self.path), load_cfg=load_cfg, strict=True, map_location=device)
