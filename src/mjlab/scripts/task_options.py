"""Flags that a task brings itself: see `mjlab.tasks.registry`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from mjlab.tasks.registry import PolicyOrigin, TaskOptions, load_options_cls

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg

C = TypeVar("C")

_FIELD = "options"


def with_task_options(cfg: C, task: str) -> C:
    """Return the flags of a command with those of the task's own, if it has any.

    Args:
        cfg: A dataclass, the flags with their defaults.
        task: Name of the task.

    Raises:
        UnknownTaskError, TaskImportError: there is no such task, or its options cannot be imported.
        ValueError: an option of the task has the name of a flag of the command.
    """
    options = load_options_cls(task)
    if options is None:
        return cfg
    import tyro

    own: Any = cfg
    values = {field.name: getattr(own, field.name) for field in dataclasses.fields(own)}
    taken = sorted({field.name for field in dataclasses.fields(options)} & values.keys())
    if taken:
        raise ValueError(
            f"The options of task {task!r} ({options.__name__}) have {taken}, which are flags of "
            "the command already; give them other names."
        )
    # Without a prefix, as if the fields were the command's own.
    annotation: Any = Annotated[options, tyro.conf.arg(name="")]  # ty: ignore[invalid-type-form]
    kind: Any = dataclasses.make_dataclass(
        type(cfg).__name__,
        [(_FIELD, annotation, dataclasses.field(default_factory=options))],
        bases=(type(cfg),),
        namespace={"__doc__": type(cfg).__doc__, "__module__": type(cfg).__module__},
    )
    return kind(**values)


def options_of(task: str, cfg: Any) -> TaskOptions:
    """Return the task's options in the flags of a command, or their defaults."""
    options = getattr(cfg, _FIELD, None)
    if options is not None:
        return options
    return (load_options_cls(task) or TaskOptions)()


def prepare_env_cfg(
    task: str,
    cfg: Any,
    env_cfg: ManagerBasedRlEnvCfg,
    checkpoint: Path | None,
    wandb_run_path: str | None = None,
) -> None:
    """Let the task get what it needs before its environment is built; `env_cfg` is edited.

    Args:
        task: Name of the task.
        cfg: The flags of the command, or None for the task's defaults.
        env_cfg: The environment's config.
        checkpoint: The checkpoint of the policy that is to act, if there is one.
        wandb_run_path: Where the checkpoint was fetched from, if it was.

    Raises:
        ValueError: what the task needs is not there.
    """
    origin = PolicyOrigin(task, checkpoint, wandb_run_path)
    options_of(task, cfg).prepare(env_cfg, origin)
