"""Gymnasium registration: importing this module registers each task as `mjlab/NAME`.

```python
import gymnasium
import mjlab.gymnasium

envs = gymnasium.make_vec("mjlab/Mjlab-Velocity-Flat-Unitree-Go1", num_envs=512)
```

Equivalent without the second import: `make_vec("mjlab.gymnasium:mjlab/Mjlab-Velocity-Flat-Unitree-Go1")`.
Requires Gymnasium (`pip install "mjlab[gymnasium]"`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium

from mjlab.tasks.registry import list_tasks, load_env_cfg
from mjlab.utils.errors import UnsupportedError

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnvCfg
    from mjlab.rl.gymnasium_vector import GymnasiumVectorEnv

logger = logging.getLogger(__name__)

NAMESPACE = "mjlab"


def register_tasks() -> None:
    """Register all tasks that are not yet in Gymnasium's registry."""
    for task in list_tasks():
        name = f"{NAMESPACE}/{task}"
        if name in gymnasium.registry:
            continue
        try:
            gymnasium.register(
                name,
                "mjlab.gymnasium:make_env",
                vector_entry_point="mjlab.gymnasium:make_vec_env",
                kwargs={"task": task},
            )
        except gymnasium.error.Error as error:
            logger.warning("Task %r not added to Gymnasium's registry: %s", task, error)


def make_env(task: str, **kwargs: Any) -> gymnasium.Env:
    """Raise UnsupportedError: tasks are vector environments. Entry point of `gymnasium.make`."""
    raise UnsupportedError(
        f"gymnasium.make: expected a single environment, got {NAMESPACE}/{task}, a vector environment; "
        f'use gymnasium.make_vec("{NAMESPACE}/{task}", num_envs=1).'
    )


def make_vec_env(
    task: str,
    num_envs: int = 1,
    *,
    play: bool = False,
    profile: str | None = None,
    device: str | None = None,
    seed: int | None = None,
    render_mode: str | None = None,
    group: str | None = None,
    clip_actions: float | None = None,
    tensors: bool = False,
    edit: Callable[[ManagerBasedRlEnvCfg], None] | None = None,
) -> GymnasiumVectorEnv:
    """Create the vector environment of a task. Entry point of `gymnasium.make_vec`.

    Args:
        task: Task name.
        num_envs: Number of environments.
        play: Use the play config instead of the training config.
        profile: Profile of the task.
        device: Torch device. None: a GPU if available.
        seed: Seed of the environment; `reset(seed=...)` changes it.
        render_mode: `rgb_array`, or None.
        group: See `mjlab.rl.gymnasium_env`.
        clip_actions: See `mjlab.rl.gymnasium_env`.
        tensors: See `mjlab.rl.gymnasium_env`.
        edit: Function that modifies the task's config before the environments are built.

    Raises:
        UnknownTaskError: unknown task.
        UnknownProfileError: unknown profile.
        ValueError: invalid config, device or group.
    """
    import torch

    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl.gymnasium_vector import gymnasium_env

    cfg = load_env_cfg(task, play=play, profile=profile)
    cfg.scene.num_envs = num_envs
    if seed is not None:
        cfg.seed = seed
    if edit is not None:
        edit(cfg)
    device = device or ("cuda:0" if torch.cuda.is_available() else "cpu")
    env = ManagerBasedRlEnv(cfg, device, render_mode)
    return gymnasium_env(env, group, clip_actions, tensors)


register_tasks()
