"""Selection of the reference motion: flags, the run of the policy, or the task config."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.tasks.registry import PolicyOrigin, TaskOptions, load_env_cfg
from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_sources import (
    FOLDER,
    fetch_artifact,
    fetch_motions_of_run,
    find_motions,
    recorded_motions,
)

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.tasks.tracking.mdp.commands import MotionCommandCfg

logger = logging.getLogger(__name__)


@dataclass
class MotionOptions(TaskOptions):
    """Flags that select the reference motion.

    Priority: `motion_file`, `registry_name`, the motion of the environment config if changed, the
    motions recorded by the policy's run, the default of the environment config.
    """

    unrecorded = ("motion_file", "registry_name")
    run_files = (f"{FOLDER}/*",)

    motion_file: str | None = None
    """Motions to imitate: files, folders, or names of bundled motions (e.g. squat), separated by
    commas. None: the motions the policy was trained on, or the task's default."""
    registry_name: str | None = None
    """Weights & Biases artifact of the motion, as org/collection/name or name:alias. Default alias:
    latest."""

    def prepare(self, env_cfg: ManagerBasedRlEnvCfg, origin: PolicyOrigin) -> None:
        """Write the motion into the command's config.

        Raises:
            MotionFileError: both flags are set, or a motion is not found.
        """
        if self.motion_file is not None and self.registry_name is not None:
            raise MotionFileError("Expected --motion-file or --registry-name, got both; use one.")
        command = motion_cfg(env_cfg)
        files = self._files(command, origin)
        if files is not None:
            command.motion_file = ",".join(str(path) for path in files)
        names = [path.stem for path in find_motions(command.motion_file)]
        logger.info("Motion:  %s", ", ".join(names))

    def runner_kwargs(self) -> dict[str, Any]:
        """Return the registry name, recorded by the run as a used artifact."""
        return {"registry_name": self.registry_name}

    def _files(self, command: MotionCommandCfg, origin: PolicyOrigin) -> Sequence[Path] | None:
        """Return the motions to imitate; None keeps the motions of the config."""
        if self.motion_file is not None:
            return find_motions(self.motion_file)
        if self.registry_name is not None:
            return fetch_artifact(self.registry_name)
        recorded = None if origin.checkpoint is None else recorded_motions(origin.checkpoint.parent)
        if command.motion_file != motion_cfg(load_env_cfg(origin.task)).motion_file:
            try:
                return find_motions(command.motion_file)
            except MotionFileError:
                # The path is of another machine if the run was copied.
                return recorded or None
        if origin.wandb_run_path is not None:
            return fetch_motions_of_run(origin.wandb_run_path)
        if origin.checkpoint is None:
            return None
        if not recorded:
            logger.warning(
                "The run of %s has no recorded motion; using %s. Use --motion-file to select one.",
                origin.checkpoint, command.motion_file,
            )  # fmt: skip
        return recorded or None


def motion_cfg(env_cfg: Any) -> MotionCommandCfg:
    """Return the config of the motion command; raises `ValueError` if not found."""
    from mjlab.tasks.tracking.mdp.commands import MotionCommandCfg

    for cfg in env_cfg.commands.values():
        if isinstance(cfg, MotionCommandCfg):
            return cfg
    raise ValueError(f"Task commands: expected a MotionCommandCfg, got {list(env_cfg.commands)}.")
