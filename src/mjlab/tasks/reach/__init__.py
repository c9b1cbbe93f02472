"""Reach tasks: an arm moves its hand to goal poses."""

from __future__ import annotations

from mjlab.tasks.registry import register_mjlab_task

# By name, so that nothing heavy is imported.
register_mjlab_task(
    task_id="Mjlab-Reach-Yam",
    env_cfg="mjlab.tasks.reach.yam_env_cfg:yam_reach_env_cfg",
    rl_cfg="mjlab.tasks.reach.rl_cfg:yam_reach_ppo_runner_cfg",
    profiles={"cpu": "mjlab.tasks.reach.rl_cfg:cpu"},
)
