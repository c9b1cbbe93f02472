"""PPO settings of the velocity tasks, their profiles, and the errors that evaluations measure.

The `cpu` profile is the Go1's, and for other robots; the G1 has its own. A few cores step some ten
thousand environments a second, a hundredth of a GPU. Under the task's own settings a robot has not left its
first idea by then, which is to stand still: trying to move costs more penalty than it earns. So the profile
makes the task easier to learn, not easier to pass:

- Penalties start at a fraction of their weight and grow to it, those that lift the feet sooner than
  the others, and so do pushes; a reward for feet in the air, which the task has but does not weigh,
  fades out meanwhile.
- Contacts have no rolling and torsional friction, and a pyramidal friction cone. The solver then
  takes half the time.
- The mirror image of each sample is one more sample. Without it, a policy walks as soon, and stumbles
  far longer in the directions that it has seen least.
- Batches and networks are small, a policy may change more in an iteration, and rewards far away count
  less: what a leg does shows within a second.

Evaluations, `play` and `evaluate` undo the first two: what they show is the task as it is.

The `blind` profile is for rough terrain: a student that does not see the ground. A teacher with the height
scan learns first, under the profile `cpu`. The student then learns to act as the teacher does, from the
other observations of the last steps.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlBaseRunnerCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
    gaussian_distribution,
)
from mjlab.rl.learners import with_learner
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import ease_weight

_STUDENT = "student"
_SCAN = "height_scan"
# How a foot met the ground shows for about two tenths of a second.
_BLIND_HISTORY = 10
_BLIND_STEPS = 24
_ROBOT = "robot"
_COMMAND = "twist"
_AIR_TIME = "air_time"
_NUM_ENVS = 512
_PENALTY_AT_FIRST = 0.02
_AIR_TIME_AT_FIRST = 0.5
_EASED_SAMPLES = 6_000_000
# Whoever drags the feet falls at each change of command.
_LIFTING = ("foot_clearance", "foot_swing_height")
_LIFTING_EASED_SAMPLES = 2_000_000


def velocity_ppo_runner_cfg(experiment_name: str, max_iterations: int) -> RslRlOnPolicyRunnerCfg:
    """Return the PPO settings of a robot."""
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(512, 256, 128),
            obs_normalization=True,
            distribution_cfg=gaussian_distribution(),
        ),
        critic=RslRlModelCfg(hidden_dims=(512, 256, 128), obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(entropy_coef=0.01),
        experiment_name=experiment_name,
        max_iterations=max_iterations,
        evaluation=EvaluationCfg(metrics=dict(TRACKING_ERRORS)),
    )


def lin_vel_error(env: Any) -> torch.Tensor:
    """Return |c_xy - v_xy|, (num_envs,), in m/s: linear velocity of the root link, in its frame."""
    command = env.command_manager.get_command(_COMMAND)
    return (command[:, :2] - env.scene[_ROBOT].data.root_link_lin_vel_b[:, :2]).norm(dim=-1)


def ang_vel_error(env: Any) -> torch.Tensor:
    """Return |c_z - w_z|, (num_envs,), in rad/s: turning rate of the root link, in its frame."""
    command = env.command_manager.get_command(_COMMAND)
    return (command[:, 2] - env.scene[_ROBOT].data.root_link_ang_vel_b[:, 2]).abs()


TRACKING_ERRORS = {"lin_vel_error": lin_vel_error, "ang_vel_error": ang_vel_error}
"""The errors by the name under which evaluations report them."""


# Profiles.


def _ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> None:
    for name, term in env_cfg.rewards.items():
        if term is None or (term.weight >= 0 and name != _AIR_TIME):
            continue
        first = _AIR_TIME_AT_FIRST if name == _AIR_TIME else _PENALTY_AT_FIRST * term.weight
        samples = _LIFTING_EASED_SAMPLES if name in _LIFTING else _EASED_SAMPLES
        ease_weight(env_cfg, name, first, samples // _NUM_ENVS)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 200
    evaluation.min_interval = 40
    evaluation.trigger_return = 3600.0
    terrain = env_cfg.scene.terrain
    if terrain is not None and terrain.terrain_type == "plane":
        # There a Go1 may walk after a minute, long before the training return is that high.
        evaluation.first_iteration, evaluation.trigger_return = 80, -math.inf
    evaluation.solved_below = {"lin_vel_error": 0.25, "ang_vel_error": 0.35, "failure_rate": 0.05}


cpu = cpu_profile(
    _ease,
    num_envs=_NUM_ENVS,
    init_std=0.8,
    simple_contacts=True,
    unpushed_samples=2_000_000,
    mirror="mjlab.tasks.velocity.symmetry:mirror_left_right",
)
"""Profile of the velocity tasks."""


def blind(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> RslRlBaseRunnerCfg:
    """Edit the task's config in place as `cpu` does, and return the config of a distillation."""
    cpu(env_cfg, rl_cfg)
    student = copy.deepcopy(env_cfg.observations["actor"])
    assert student is not None
    del student.terms[_SCAN]
    student.history_length = _BLIND_HISTORY
    env_cfg.observations[_STUDENT] = student
    rl_cfg.num_steps_per_env = _BLIND_STEPS
    cfg = with_learner(rl_cfg, "distillation")
    cfg.obs_groups["student"] = (_STUDENT,)
    return cfg
