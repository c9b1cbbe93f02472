"""A task for release 1.6: a turntable that points its arm."""

from mjlab.tasks.registry import register_mjlab_task

from . import names as names
from .turntable import PointRunner, turntable_env_cfg, turntable_rl_cfg

register_mjlab_task(
    task_id="Tasks16-Turntable",
    env_cfg=turntable_env_cfg(),
    play_env_cfg=turntable_env_cfg(play=True),
    rl_cfg=turntable_rl_cfg(),
    runner_cls=PointRunner,
)
