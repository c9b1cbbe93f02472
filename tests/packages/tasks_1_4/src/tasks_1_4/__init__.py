"""A task for release 1.4: a finger that pushes another block in each environment."""

from mjlab.tasks.registry import register_mjlab_task

from . import names as names
from .push import SearchRunner, push_env_cfg, push_rl_cfg

register_mjlab_task(
    task_id="Tasks14-Push",
    env_cfg=push_env_cfg(),
    play_env_cfg=push_env_cfg(play=True),
    rl_cfg=push_rl_cfg(),
)
register_mjlab_task(
    task_id="Tasks14-Search",
    env_cfg=push_env_cfg(),
    play_env_cfg=push_env_cfg(play=True),
    rl_cfg=push_rl_cfg(),
    runner_cls=SearchRunner,
)
