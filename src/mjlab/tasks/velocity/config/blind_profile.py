"""The `blind` profile of velocity tasks on rough terrain: a student that does not see the ground.

A teacher with the height scan learns first, under the profile `cpu`. The student then learns to act as
the teacher does, from the other observations of the last steps.
"""

from __future__ import annotations

import copy

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlOnPolicyRunnerCfg
from mjlab.rl.learners import with_learner
from mjlab.tasks.velocity.rl.ppo import cpu

_STUDENT = "student"
_SCAN = "height_scan"
# How a foot met the ground shows for about two tenths of a second.
_HISTORY = 10
_NUM_STEPS = 24


def blind(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> RslRlBaseRunnerCfg:
    """Edit the task's config in place as `cpu` does, and return that of a distillation."""
    cpu(env_cfg, rl_cfg)
    student = copy.deepcopy(env_cfg.observations["actor"])
    assert student is not None
    del student.terms[_SCAN]
    student.history_length = _HISTORY
    env_cfg.observations[_STUDENT] = student
    rl_cfg.num_steps_per_env = _NUM_STEPS
    cfg = with_learner(rl_cfg, "distillation")
    cfg.obs_groups["student"] = (_STUDENT,)
    return cfg
