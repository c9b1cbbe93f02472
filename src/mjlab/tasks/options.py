"""What a task adds to the command line, and how it gets what it needs before it is built.

A task that needs something (a recorded motion, say) is registered with a dataclass, `options=`, whose
fields become flags of `train`, `play`, `evaluate` and `profile-env` for this task. The scripts know
nothing of what is in it: they call `prepare` before they build the environment.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class PolicyOrigin:
    """Where the policy comes from that is to act, as far as there is one."""

    task: str
    """Name of the task."""
    checkpoint: Path | None = None
    """Its checkpoint, in the folder of its run; also the one that training goes on from."""
    wandb_run_path: str | None = None
    """The Weights & Biases run that the checkpoint was fetched from, as entity/project/run."""


@dataclass
class TaskOptions:
    """Base of the options of a task: a dataclass with a default for each field."""

    def prepare(self, env_cfg: Any, origin: PolicyOrigin) -> None:
        """Edit the environment's config in place, fetching what it needs.

        Called once, before the environment is built; by every process where there are several.

        Args:
            env_cfg: The config, with all flags applied.
            origin: Whose policy is to act.

        Raises:
            ValueError: what is needed is not there; the message says what to do.
        """

    def runner_kwargs(self) -> dict[str, Any]:
        """Return further keyword arguments of the task's runner."""
        return {}
