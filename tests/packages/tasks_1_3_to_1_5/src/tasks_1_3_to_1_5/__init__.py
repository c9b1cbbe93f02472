"""Tasks for releases 1.3 to 1.5: an arm, a finger that pushes blocks, a hopper that imitates."""

from mjlab.tasks.registry import register_mjlab_task
from mjlab.tasks.tracking.rl import MotionTrackingOnPolicyRunner

from . import names as names
from .arm import ArmRunner, arm_env_cfg
from .imitate import imitate_env_cfg
from .push import SearchRunner, push_env_cfg
from .rl_cfg import make_recurrent_rl_cfg, make_rl_cfg
from .sway import sway_env_cfg

for task, make_env_cfg, rl_cfg, runner in (
    ("Arm", arm_env_cfg, make_recurrent_rl_cfg("tasks_1_3_arm"), ArmRunner),
    ("Push", push_env_cfg, make_rl_cfg("tasks_1_4_push"), None),
    ("Search", push_env_cfg, make_rl_cfg("tasks_1_4_push"), SearchRunner),
    ("Imitate", imitate_env_cfg, make_rl_cfg("tasks_1_5_imitate"), MotionTrackingOnPolicyRunner),
    ("Sway", sway_env_cfg, make_rl_cfg("tasks_1_5_sway"), MotionTrackingOnPolicyRunner),
):
    register_mjlab_task(
        task_id=f"Tasks15-{task}",
        env_cfg=make_env_cfg(),
        play_env_cfg=make_env_cfg(play=True),
        rl_cfg=rl_cfg,
        runner_cls=runner,
    )
