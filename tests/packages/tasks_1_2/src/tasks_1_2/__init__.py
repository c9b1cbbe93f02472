"""A task for release 1.2: a rover that drives as told."""

from mjlab.tasks.registry import register_mjlab_task

from . import names as names
from .report import rover_summary as rover_summary
from .rover import rover_env_cfg, rover_rl_cfg

register_mjlab_task(
    task_id="Tasks12-Rover",
    env_cfg=rover_env_cfg(),
    play_env_cfg=rover_env_cfg(play=True),
    rl_cfg=rover_rl_cfg(),
)
