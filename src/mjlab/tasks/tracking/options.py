"""How motion tracking gets its motion: flags, the run that the policy comes from, or its config."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjlab.tasks.registry import PolicyOrigin, TaskOptions, load_env_cfg
from mjlab.tasks.tracking.motion_file import MotionFileError
from mjlab.tasks.tracking.motion_sources import (
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
    """Flags that say which motion is imitated.

    The first that applies: `motion_file`, `registry_name`, the motion of the environment's config
    where it was changed, the motions that the policy's run recorded, and the config's own.
    """

    motion_file: str | None = None
    """Motions to imitate: files, folders, or names of motions that ship with the package (such as
    squat), separated by commas. None: those that the policy was trained on, or the task's own."""
    registry_name: str | None = None
    """Weights & Biases artifact with the motion, as org/collection/name or name:alias; without an
    alias, the latest."""

    def prepare(self, env_cfg: ManagerBasedRlEnvCfg, origin: PolicyOrigin) -> None:
        """Write the motion into the command's config.

        Raises:
            MotionFileError: both flags are given, or a motion is not there.
        """
        command = motion_cfg(env_cfg)
        files = self._files(command, origin)
        if files is not None:
            command.motion_file = ",".join(str(path) for path in files)
        names = [path.stem for path in find_motions(command.motion_file)]
        logger.info("Motion:  %s", ", ".join(names))

    def runner_kwargs(self) -> dict[str, Any]:
        """Return the registry's name, with which a run is marked."""
        return {"registry_name": self.registry_name}

    def _files(self, command: MotionCommandCfg, origin: PolicyOrigin) -> Sequence[Path] | None:
        """Return the motions to imitate; None leaves those of the config."""
        if self.motion_file is not None and self.registry_name is not None:
            raise MotionFileError("Give --motion-file or --registry-name, and not both.")
        if self.motion_file is not None:
            return find_motions(self.motion_file)
        if self.registry_name is not None:
            return fetch_artifact(self.registry_name)
        if command.motion_file != motion_cfg(load_env_cfg(origin.task)).motion_file:
            return None
        if origin.wandb_run_path is not None:
            return fetch_motions_of_run(origin.wandb_run_path)
        if origin.checkpoint is None:
            return None
        recorded = recorded_motions(origin.checkpoint.parent)
        if not recorded:
            logger.warning(
                "The run of %s recorded no motion; %s is taken. --motion-file names another.",
                origin.checkpoint, command.motion_file,
            )  # fmt: skip
        return recorded or None


def motion_cfg(env_cfg: Any) -> MotionCommandCfg:
    """Return the config of the motion command; raises `ValueError` if there is none."""
    from mjlab.tasks.tracking.mdp.commands import MotionCommandCfg

    for cfg in env_cfg.commands.values():
        if isinstance(cfg, MotionCommandCfg):
            return cfg
    raise ValueError(
        f"The task has no MotionCommandCfg; its commands are {list(env_cfg.commands)}."
    )
