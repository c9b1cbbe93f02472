"""Two tasks for release 1.5: imitation by the interface's motion command and by another one."""

from mjlab.tasks.registry import register_mjlab_task
from mjlab.tasks.tracking.rl import MotionTrackingOnPolicyRunner

from . import names as names
from .imitate import imitate_env_cfg, imitate_rl_cfg
from .sway import sway_env_cfg, sway_rl_cfg

register_mjlab_task(
    task_id="Tasks15-Imitate",
    env_cfg=imitate_env_cfg(),
    play_env_cfg=imitate_env_cfg(play=True),
    rl_cfg=imitate_rl_cfg(),
    runner_cls=MotionTrackingOnPolicyRunner,
)
register_mjlab_task(
    task_id="Tasks15-Sway",
    env_cfg=sway_env_cfg(),
    play_env_cfg=sway_env_cfg(play=True),
    rl_cfg=sway_rl_cfg(),
    runner_cls=MotionTrackingOnPolicyRunner,
)
