"""Learner configs of the velocity tasks of the Unitree G1: PPO, and the `cpu` profile.

With the profile, a humanoid learns to walk on two cores. PPO does not learn to walk in an hour, so the learner is
SAC (`mjlab.rl.sac`), and the task is made easier to learn, not easier to pass. `docs/guides/learning.md` has
the experiments.

- A textbook controller steps in place (`stepping_action`). The controller acts for the first 60 environment
  steps, and the policy imitates it, with decreasing weight, for the first 1,200 of about 3,000. Without
  imitation, policies only learn to stand.
- Actions are bounded, and policies observe a gait clock, Unitree's `gait_phase`, and the last five joint
  positions, velocities and gravity directions of the base. The history filters noise; without state
  estimation, it also shows how fast the base moves over its standing foot. Policies keep all three.
- Rewards define the gait: feet at the height given by the clock and apart from each other, a pelvis at constant
  height and upright, joints near the default pose. The penalties of the task stay.
- Commands and pushes grow with a curriculum.
- The decimation is three, and feet have two capsules instead of seven. Legs and hands still collide;
  otherwise feet pass through each other. The number of solver iterations is unchanged: with four, feet
  slip on ground of high friction.

Evaluations, `evaluate` and `play` use the task's physics, rewards, commands, pushes, noise and terminations.
"""

from __future__ import annotations

import copy
import math

from mjlab.asset_zoo.robots.unitree_g1.g1_constants import FULL_COLLISION
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.managers import (
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from mjlab.rl.config import (
    RslRlBaseRunnerCfg,
    RslRlOffPolicyRunnerCfg,
    RslRlOnPolicyRunnerCfg,
    squashed_gaussian,
)
from mjlab.rl.learners import with_learner
from mjlab.tasks.easing import coarsen_physics, grow_difficulty
from mjlab.tasks.registry import Profile
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.rl.ppo import velocity_ppo_runner_cfg

_NUM_ENVS = 1024
_FEET = SceneEntityCfg("robot", site_names=("left_foot", "right_foot"))
_CLOCK = "gait"
_TEACHER = "teacher"
_LINEAR = "linear"
_STRIDES_PER_SECOND = 1.88
"""Stride frequency (Hz) that the gains of the stepping controller are tuned for."""
# Observations with history, to filter noise.
_FILTERED = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos")
_HISTORY = 5
# Largest offset of a joint target from the default pose (rad).
_BOUNDS = {
    r".*_(hip_pitch|knee|ankle_pitch)_joint": 1.0,
    r".*_hip_(roll|yaw)_joint": 0.6,
    r".*_ankle_roll_joint": 0.8,
    r"waist_.*_joint": 0.25,
    r".*_shoulder_pitch_joint": 0.4,
    r".*_shoulder_(roll|yaw)_joint": 0.2,
    r".*_elbow_joint": 0.3,
    r".*_wrist_.*_joint": 0.1,
}
# Weights of squared joint deviations from the default pose, from the G1 of UniLab (arXiv 2605.30313).
_POSE = {
    r".*_(hip_pitch|knee)_joint": 0.01,
    r".*_hip_roll_joint": 1.0,
    r".*_(hip_yaw|ankle_pitch|ankle_roll)_joint": 5.0,
    r"(waist|.*_shoulder|.*_elbow|.*_wrist)_.*": 50.0,
}
# Rewards of the gait. They replace those of the task; its penalties stay.
_GAIT_REWARDS = {
    # The narrow kernel gives no gradient at first, the wide one too little in the end.
    _LINEAR: RewardTermCfg(
        func=mdp.track_linear_velocity, weight=3.0, params={"std": 0.5, "command_name": "twist"}
    ),
    "linear_wide": RewardTermCfg(
        func=mdp.track_linear_velocity, weight=3.0, params={"std": 1.0, "command_name": "twist"}
    ),
    "angular": RewardTermCfg(
        func=mdp.track_angular_velocity, weight=4.5, params={"std": 0.5, "command_name": "twist"}
    ),
    "alive": RewardTermCfg(func=envs_mdp.is_alive, weight=4.0),
    "feet": RewardTermCfg(
        func=mdp.feet_height_by_phase,
        weight=5.0,
        params={"height_sensor_name": "foot_height_scan"},
    ),
    "height": RewardTermCfg(
        func=mdp.root_height_l2,
        weight=-50.0,
        params={"target_height": 0.74, "asset_cfg": copy.deepcopy(_FEET)},
    ),
    "apart": RewardTermCfg(
        func=mdp.feet_apart_l2,
        weight=-100.0,
        params={"distance": 0.2, "asset_cfg": copy.deepcopy(_FEET)},
    ),
    "rolling": RewardTermCfg(func=mdp.body_angular_velocity_penalty, weight=-0.5),
    "tilt": RewardTermCfg(func=envs_mdp.flat_orientation_l2, weight=-5.0),
    "deviation": RewardTermCfg(
        func=mdp.weighted_joint_deviation, weight=-0.25, params={"weights": _POSE}
    ),
    "soles": RewardTermCfg(
        func=mdp.feet_tilt, weight=-2.5, params={"asset_cfg": copy.deepcopy(_FEET)}
    ),
}
# Colliding geoms: the long capsules of the feet, and the limbs that feet or hands may hit.
_FOOT = r"^(left|right)_foot[26]_collision$"
_LIMBS = tuple(
    rf".*_{part}_collision" for part in ("shin", "linkage_brace", "thigh", "hip", "hand", "wrist")
)


def unitree_g1_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO config of all tasks."""
    return velocity_ppo_runner_cfg(experiment_name="g1_velocity", max_iterations=30_000)


def _set_policy(
    env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg
) -> RslRlOffPolicyRunnerCfg:
    """Add the stepping controller, and return the learner config.

    Solved: four of five episodes last 20 s, with the task's pushes, and tracking errors are small.
    """
    _add_stepping(env_cfg)
    return _learner(rl_cfg)


def _add_stepping(env_cfg: ManagerBasedRlEnvCfg) -> None:
    """Bound actions, and add a gait clock, observation history and the stepping controller as teacher."""
    # As Unitree's `gait_phase`: starts at 0, and always runs.
    env_cfg.commands[_CLOCK] = mdp.GaitClockCommandCfg(
        frequency=_STRIDES_PER_SECOND, starts=(0.0,), velocity_command_name=None
    )
    for group in env_cfg.observations.values():
        group.terms[_CLOCK] = ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": _CLOCK}
        )
    actor = env_cfg.observations["actor"]
    for name in _FILTERED:
        if name in actor.terms and actor.history_length is None:
            actor.terms[name].history_length = _HISTORY
    env_cfg.observations[_TEACHER] = ObservationGroupCfg(
        terms={"step": ObservationTermCfg(func=mdp.stepping_action)}
    )
    env_cfg.actions["joint_pos"] = envs_mdp.JointPositionActionCfg(
        entity_name="robot", actuator_names=(".*",), scale=dict(_BOUNDS)
    )


def _learner(rl_cfg: RslRlOnPolicyRunnerCfg) -> RslRlOffPolicyRunnerCfg:
    cfg = with_learner(rl_cfg, "sac")
    assert isinstance(cfg, RslRlOffPolicyRunnerCfg)
    cfg.num_steps_per_env = 25
    cfg.max_iterations = 400
    cfg.save_interval = 20
    cfg.actor.hidden_dims = cfg.critic.hidden_dims = (256, 128, 64)
    cfg.actor.distribution_cfg = squashed_gaussian(0.15, log_std_max=-1.2)
    algorithm = cfg.algorithm
    # Five updates of batch size 2,048 take as long as stepping 1,024 environments; replay ratio: 10.
    algorithm.num_updates = 5
    algorithm.replay_steps = 600
    algorithm.learning_starts = 20
    algorithm.value_range = (-5.0, 15.0)
    algorithm.tau = 0.08
    algorithm.actor_learning_rate = 1.5e-3
    algorithm.critic_learning_rate = 6e-4
    algorithm.init_alpha = 0.002
    algorithm.alpha_learning_rate = 1e-2
    algorithm.alpha_range = (1e-5, 0.05)
    algorithm.mean_penalty = 0.02
    algorithm.policy_average = 0.05
    algorithm.use_mixed_precision = True
    algorithm.teacher = _TEACHER
    algorithm.teacher_steps = 60
    algorithm.imitation = ((100, 2.0), (400, 0.1), (800, 0.1), (1200, 0.0))
    algorithm.symmetry_cfg = {
        "data_augmentation_func": "mjlab.tasks.velocity.symmetry:mirror_left_right"
    }
    evaluation = cfg.evaluation
    # An evaluation costs two iterations. With exploration, errors are a tenth larger, and before
    # iteration 80 pushes and commands are those of an easy start.
    evaluation.num_episodes = 60
    evaluation.first_iteration, evaluation.min_interval = 80, 10
    evaluation.trigger_return = -math.inf
    evaluation.trigger_below = {"lin_vel_error": 0.37, "ang_vel_error": 0.52}
    evaluation.solved_below = {"lin_vel_error": 0.35, "ang_vel_error": 0.45, "failure_rate": 0.2}
    return cfg


def _ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg) -> None:
    env_cfg.scene.num_envs = _NUM_ENVS
    coarsen_physics(env_cfg, num_steps=3)
    fewer = copy.deepcopy(FULL_COLLISION)
    fewer.geom_names_expr = (_FOOT, *_LIMBS)
    env_cfg.scene.entities["robot"].collisions = (fewer,)
    penalties = {n: term for n, term in env_cfg.rewards.items() if term and term.weight < 0.0}
    env_cfg.rewards = {
        **copy.deepcopy(_GAIT_REWARDS),
        **penalties,
        "action_rate_l2": RewardTermCfg(func=envs_mdp.action_rate_l2, weight=-0.5),
        "dof_pos_limits": RewardTermCfg(func=envs_mdp.joint_pos_limits, weight=-2.5),
    }
    # Terminate falling robots earlier: the rest of a fall teaches little.
    env_cfg.terminations["fell_over"].params["limit_angle"] = math.radians(60.0)
    env_cfg.terminations["sank"] = TerminationTermCfg(
        func=mdp.root_near_feet,
        params={"minimum_height": 0.5, "asset_cfg": copy.deepcopy(_FEET)},
    )
    grow_difficulty(
        env_cfg,
        _LINEAR,
        tracking=0.4,
        survival=0.6,
        survival_s=6.0,
        interval=25,
        command_from=0.6,
        push_from=0.1,
        noise_from=1.0,
    )


cpu = Profile(_set_policy, _ease)
"""The `cpu` profile of all tasks."""
