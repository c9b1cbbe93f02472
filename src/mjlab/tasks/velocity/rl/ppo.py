"""TODO."""

from __future__ import annotations

import math
from typing import Any

import torch

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import (
    EvaluationCfg,
    RslRlModelCfg,
    RslRlOnPolicyRunnerCfg,
    RslRlPpoAlgorithmCfg,
    gaussian_distribution,
)
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import ease_weight

# MERGED mjlab.tasks.velocity.rl.ppo: What evaluations of the velocity task measure: how far the robot is from its command.

_ROBOT = "robot"
_COMMAND = "twist"


def lin_vel_error(env: Any) -> torch.Tensor:
    """Return |c_xy - v_xy|, (num_envs,), in m/s: linear velocity of the root link, in its frame."""
    return (_command(env)[:, :2] - _robot(env).root_link_lin_vel_b[:, :2]).norm(dim=-1)


def ang_vel_error(env: Any) -> torch.Tensor:
    """Return |c_z - w_z|, (num_envs,), in rad/s: turning rate of the root link, in its frame."""
    return (_command(env)[:, 2] - _robot(env).root_link_ang_vel_b[:, 2]).abs()


def _command(env: Any) -> torch.Tensor:
    return env.command_manager.get_command(_COMMAND)


def _robot(env: Any) -> Any:
    return env.scene[_ROBOT].data


TRACKING_ERRORS = {"lin_vel_error": lin_vel_error, "ang_vel_error": ang_vel_error}
"""The errors by the name under which evaluations report them."""


# MERGED mjlab.tasks.velocity.rl.ppo: What all robots share of how they learn the velocity task.


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


# MERGED mjlab.tasks.velocity.rl.ppo: The `cpu` profile of velocity tasks: the Go1's, and for robots of one's own. The G1 has another.
#
# A few cores step some ten thousand environments a second, a hundredth of a GPU. Under the task's own
# settings a robot has not left its first idea by then, which is to stand still: trying to move costs
# more penalty than it earns. So the profile makes the task easier to learn, not easier to pass:
#
# - Penalties start at a fraction of their weight and grow to it, those that lift the feet sooner than
#   the others, and so do pushes; a reward for feet in the air, which the task has but does not weigh,
#   fades out meanwhile.
# - Contacts have no rolling and torsional friction, and a pyramidal friction cone. The solver then
#   takes half the time.
# - The mirror image of each sample is one more sample. Without it, a policy walks as soon, and stumbles
#   far longer in the directions that it has seen least.
# - Batches and networks are small, a policy may change more in an iteration, and rewards far away count
#   less: what a leg does shows within a second.
#
# Evaluations, `play` and `evaluate` undo the first two: what they show is the task as it is.

_AIR_TIME = "air_time"
_NUM_ENVS = 512
_PENALTY_AT_FIRST = 0.02
_AIR_TIME_AT_FIRST = 0.5
_EASED_SAMPLES = 6_000_000

# Whoever drags the feet falls at each change of command.
_LIFTING = ("foot_clearance", "foot_swing_height")
_LIFTING_EASED_SAMPLES = 2_000_000


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
