"""The `cpu` profile of bipeds: a humanoid learns to walk on two cores.

PPO does not learn to walk in an hour, so the learner is SAC (`mjlab.rl.sac`), and the task is made easier to
learn, not easier to pass. `docs/guides/experiments.md` has the experiments, with the Unitree G1.

- A textbook controller steps in place (`stepping_action`). The controller acts for the first 60 environment
  steps, and the policy imitates it, with decreasing weight, for the first 1,200 of about 3,000. Without
  imitation, policies only learn to stand.
- Actions are bounded, and policies observe a gait clock, Unitree's `gait_phase`, and the last five joint
  positions, angular velocities and gravity directions of the base. The history filters noise; without state
  estimation, it also shows how fast the base moves over its standing foot. Policies keep all three.
- Rewards define the gait: feet at the height given by the clock and apart from each other, a trunk at constant
  height and upright, joints near the default pose. They replace the task's rewards. Its penalties stay, those
  of action rates and joint limits at several times their weight.
- Commands and pushes grow with a curriculum, pushes to 1.3 times those of the task.
- On generated terrain, robots start on all levels and keep them until they walk.

Sizes are those of the G1, 0.74 m above its feet while it walks; for other robots, frequencies, heights and
velocities scale with the height, at the same Froude number, down to 0.5 m so far. Evaluations, `evaluate`
and `play` use the task's physics, rewards, commands, pushes, noise and terminations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

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
from mjlab.tasks.easing import grow_difficulty
from mjlab.tasks.registry import Profile
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.rl.ppo import MIRROR, keep_levels
from mjlab.tasks.velocity.velocity_env_cfg import get_sensor

if TYPE_CHECKING:
    from mjlab.tasks.registry import ProfileEdit

_NUM_ENVS = 1024
_CLOCK = "gait"
_TEACHER = "teacher"
_LINEAR = "linear"
_HEIGHT = 0.74
"""Height of the G1's pelvis above its feet while it walks (m)."""
_STRIDES_PER_SECOND = 1.88
"""Stride frequency of the G1 (Hz)."""
# Observations with history, to filter noise.
_FILTERED = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos")
_HISTORY = 5
# Pushes at full difficulty: size over that of the task, and interval (s). With those of the task (1 to
# 3 s), 8.5 % (5.4 to 13.2) instead of 5 % (2.7 to 9.0) of the episodes fall after 2 M steps more.
_PUSHES, _PUSH_INTERVAL_S = 1.3, (1.0, 2.5)
# Errors in training, with exploration and harder pushes, over those of evaluations, at most in three seeds: of
# the linear velocity and others, and of the yaw rate.
_EXPLORING, _EXPLORING_YAW = 1.2, 1.35
# Until then, most robots fall within an episode, and all levels would sink.
_UNCHANGED_LEVELS_SAMPLES = 1_500_000


@dataclass(frozen=True, kw_only=True)
class Biped:
    """A biped, for the `cpu` profile."""

    feet: tuple[str, str]
    """Sites in the soles, the left one first."""
    height: float
    """Height of the root above the feet while the robot walks (m)."""
    minimum_height: float
    """Height of the root above the feet below which training episodes terminate (m)."""
    feet_distance: float
    """Lateral distance of the feet that keeps one from tripping over the other (m)."""
    bounds: dict[str, float]
    """Largest offset of a joint target from the default position (rad), by joint name pattern."""
    pose: dict[str, float]
    """Weights of squared joint deviations from the default pose, by joint name pattern."""
    has_ankles: bool = True
    """Joints below the knees, which keep the soles level. Without them, no reward depends on their tilt."""
    gains: mdp.SteppingGains | None = None
    """Gains of the stepping controller. None: those of all bipeds."""

    @property
    def time(self) -> float:
        """Time of a motion over that of the G1: sqrt(l / g) at the same Froude number."""
        return math.sqrt(self.height / _HEIGHT)

    @property
    def soles(self) -> SceneEntityCfg:
        """The feet, the left one first."""
        return SceneEntityCfg("robot", site_names=self.feet, preserve_order=True)


def cpu_with_stepping(
    robot: Biped,
    *,
    ease: ProfileEdit | None = None,
    solved_below: dict[str, float],
    num_episodes: int = 60,
    first_iteration: int = 80,
    min_interval: int = 10,
    mirror: str | None = MIRROR,
) -> Profile:
    """Return the `cpu` profile of a biped.

    Args:
        robot: The biped.
        ease: Easing of the robot's own, as in `Profile`; called first.
        solved_below: Errors (m/s, rad/s), or their shares of those of a robot that stands still, and
            failure rate below which training stops.
        num_episodes: Episodes of an evaluation.
        first_iteration: First iteration with an evaluation. Before iteration 80, pushes and commands are
            those of an easy start.
        min_interval: Iterations between evaluations. One costs two iterations.
        mirror: Symmetry augmentation function. None for a robot without left and right.
    """

    trigger_below = {
        name: limit * (_EXPLORING_YAW if name.startswith("ang_vel") else _EXPLORING)
        for name, limit in solved_below.items()
        if name != "failure_rate"
    }

    def set_policy(
        env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg
    ) -> RslRlOffPolicyRunnerCfg:
        """Add the stepping controller, and return the learner config."""
        _add_stepping(env_cfg, robot)
        return _learner(rl_cfg, mirror)

    def ease_all(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg) -> None:
        env_cfg.scene.num_envs = _NUM_ENVS
        if ease is not None:
            ease(env_cfg, rl_cfg)
        _ease(env_cfg, robot)
        evaluation = rl_cfg.evaluation
        evaluation.num_episodes = num_episodes
        evaluation.first_iteration, evaluation.min_interval = first_iteration, min_interval
        evaluation.trigger_return = -math.inf
        evaluation.trigger_below, evaluation.solved_below = dict(trigger_below), dict(solved_below)
        keep_levels(env_cfg, _UNCHANGED_LEVELS_SAMPLES)

    return Profile(set_policy, ease_all)


def _add_stepping(env_cfg: ManagerBasedRlEnvCfg, robot: Biped) -> None:
    """Bound actions, and add a gait clock, observation history and the stepping controller as teacher."""
    # As Unitree's `gait_phase`: starts at 0, and always runs.
    env_cfg.commands[_CLOCK] = mdp.GaitClockCommandCfg(
        frequency=_STRIDES_PER_SECOND / robot.time, starts=(0.0,), velocity_command_name=None
    )
    for group in ("actor", "critic"):
        env_cfg.observations[group].terms[_CLOCK] = ObservationTermCfg(
            func=mdp.generated_commands, params={"command_name": _CLOCK}
        )
    actor = env_cfg.observations["actor"]
    for name in _FILTERED:
        if name in actor.terms and actor.history_length is None:
            actor.terms[name].history_length = _HISTORY
    teacher = ObservationTermCfg(
        func=mdp.stepping_action, params={"asset_cfg": robot.soles, "gains": robot.gains}
    )
    env_cfg.observations[_TEACHER] = ObservationGroupCfg(terms={"step": teacher})
    env_cfg.actions["joint_pos"] = envs_mdp.JointPositionActionCfg(
        entity_name="robot", actuator_names=(".*",), scale=dict(robot.bounds)
    )


def _learner(rl_cfg: RslRlOnPolicyRunnerCfg, mirror: str | None) -> RslRlOffPolicyRunnerCfg:
    cfg = with_learner(rl_cfg, "sac")
    assert isinstance(cfg, RslRlOffPolicyRunnerCfg)
    cfg.num_steps_per_env = 25
    cfg.max_iterations = 400
    cfg.save_interval = 20
    cfg.actor.hidden_dims = cfg.critic.hidden_dims = (256, 128, 64)
    # At most 0.3 of a joint's bound.
    cfg.actor.distribution_cfg = squashed_gaussian(0.15, log_std_max=-1.2)
    algorithm = cfg.algorithm
    # The action term's scales are far less than the joint ranges, which have not been tried.
    algorithm.action_bounds = "scale"
    # Five updates of batch size 2,048 take as long as stepping 1,024 environments; replay ratio: 10.
    algorithm.num_updates = 5
    # With 128 steps, and without the penalty on the mean below, 46 % of the actions reach their bounds,
    # and the critic underestimates all others; with both, episodes are three times as long after 1 M.
    algorithm.replay_steps = 600
    algorithm.mean_penalty = 0.02
    algorithm.learning_starts = 20
    # With a shorter horizon (0.97), falls are too far away to matter: twice as many in training after 2 M more.
    algorithm.gamma = 0.985
    algorithm.value_range = (-10.0, 30.0)
    algorithm.tau = 0.08
    # At the critic's rate, the policy follows the critic a tenth more slowly.
    algorithm.actor_learning_rate = 1.5e-3
    algorithm.critic_learning_rate = 6e-4
    # At the full rate, policies ten iterations apart fall in 3, 20 and 7 % of the episodes.
    algorithm.learning_rate_factor = ((2200, 1.0), (3200, 0.3))
    algorithm.init_alpha = 0.002
    algorithm.alpha_learning_rate = 1e-2
    algorithm.alpha_range = (1e-5, 0.05)
    # An average over some 50 updates, against the same scatter; 0.005 from the start learns slowly.
    algorithm.policy_average = 0.02
    algorithm.use_mixed_precision = True
    algorithm.teacher = _TEACHER
    # Without imitation, it learns to stand and does not step within 2.4 M samples.
    algorithm.teacher_steps = 60
    algorithm.imitation = ((100, 2.0), (400, 0.1), (800, 0.1), (1200, 0.0))
    if mirror is not None:
        algorithm.symmetry_cfg = {"data_augmentation_func": mirror}
    return cfg


def _ease(env_cfg: ManagerBasedRlEnvCfg, robot: Biped) -> None:
    penalties = {n: term for n, term in env_cfg.rewards.items() if term and term.weight < 0.0}
    env_cfg.rewards = {
        **_gait_rewards(env_cfg, robot),
        **penalties,
        "action_rate_l2": RewardTermCfg(func=envs_mdp.action_rate_l2, weight=-0.5),
        "dof_pos_limits": RewardTermCfg(func=envs_mdp.joint_pos_limits, weight=-2.5),
    }
    push = env_cfg.events.get("push_robot")
    if push is not None:
        ranges = push.params["velocity_range"]
        push.params["velocity_range"] = {
            axis: (_PUSHES * low, _PUSHES * high) for axis, (low, high) in ranges.items()
        }
        push.interval_range_s = _PUSH_INTERVAL_S
    # Terminate falling robots earlier: the rest of a fall teaches little.
    env_cfg.terminations["fell_over"].params["limit_angle"] = math.radians(60.0)
    env_cfg.terminations["sank"] = TerminationTermCfg(
        func=mdp.root_near_feet,
        params={"minimum_height": robot.minimum_height, "asset_cfg": robot.soles},
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


def _gait_rewards(env_cfg: ManagerBasedRlEnvCfg, robot: Biped) -> dict[str, RewardTermCfg]:
    """Return the rewards of the gait. They replace those of the task; its penalties stay."""
    size, speed, turn = robot.time**2, robot.time, 1.0 / robot.time
    # Narrow kernels give no gradient at first, wide ones too little in the end. Of the yaw rate alone: rolling
    # and pitching with the steps hides how much a trunk sways.
    tracking = {
        name: RewardTermCfg(func=func, weight=weight, params={"std": std, "command_name": "twist"})
        for name, func, weight, std in (
            (_LINEAR, mdp.track_linear_velocity, 4.0, 0.5 * speed),
            ("linear_wide", mdp.track_linear_velocity, 3.0, 1.0 * speed),
            ("linear_narrow", mdp.track_linear_velocity, 3.0, 0.25 * speed),
            ("yaw", mdp.track_ang_vel_z_exp, 4.0, 0.5 * turn),
            ("yaw_narrow", mdp.track_ang_vel_z_exp, 3.0, 0.25 * turn),
        )
    }
    frames = get_sensor(env_cfg, "foot_height_scan").frame
    rewards = tracking | {
        "alive": RewardTermCfg(func=envs_mdp.is_alive, weight=4.0),
        "feet": RewardTermCfg(
            func=mdp.feet_height_by_phase,
            weight=5.0,
            params={
                "height_sensor_name": "foot_height_scan",
                "swing_height": 0.09 * size,
                "variance": 0.005 * size**2,
                "offsets": tuple(0.0 if foot.name == robot.feet[0] else 0.5 for foot in frames),
            },
        ),
        "height": RewardTermCfg(
            func=mdp.root_height_l2,
            weight=-50.0 / size**2,
            params={"target_height": robot.height, "asset_cfg": robot.soles},
        ),
        "apart": RewardTermCfg(
            func=mdp.feet_apart_l2,
            weight=-100.0 / size**2,
            params={"distance": robot.feet_distance, "asset_cfg": robot.soles},
        ),
        "rolling": RewardTermCfg(
            func=mdp.body_angular_velocity_penalty, weight=-0.5 * robot.time**2
        ),
        "tilt": RewardTermCfg(func=envs_mdp.flat_orientation_l2, weight=-5.0),
        "deviation": RewardTermCfg(
            func=mdp.weighted_joint_deviation,
            weight=-0.25,
            params={"weights": dict(robot.pose)},
        ),
    }
    if robot.has_ankles:
        rewards["soles"] = RewardTermCfg(
            func=mdp.feet_tilt, weight=-2.5, params={"asset_cfg": robot.soles}
        )
    return rewards
