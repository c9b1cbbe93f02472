"""The `cpu` profile of the Go1 on flat ground: a quadruped that walks after two minutes on two cores.

To that of the other velocity tasks (`mjlab.tasks.velocity.config.cpu_profile`) it adds what
`docs/learning.md` found to save samples:

- The legs trot in place by a clock that the policy sees. What is left to learn is where to go. Policies
  keep both.
- A reward for feet as high as the clock says, more reward for following commands, and a penalty for falls.
- The physics takes two steps of 10 ms for a step of the environment, and pushes are whole sooner.

Evaluations, `evaluate` and `play` have the task's own physics, rewards, commands, pushes, noise and ends.
"""

from __future__ import annotations

import copy

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.envs import mdp as envs_mdp
from mjlab.managers import RewardTermCfg
from mjlab.rl.config import RslRlOnPolicyRunnerCfg
from mjlab.tasks.cpu_profile import cpu_profile
from mjlab.tasks.easing import Undo, replace_rewards
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.config.cpu_profile import NUM_ENVS, ease_penalties, let_legs_march

_LEGS = ("FR", "FL", "RR", "RL")
# Diagonal legs step together.
_TROT = (0.0, 0.5, 0.5, 0.0)
# Angles in the middle of a swing (rad), which lift a foot of a leg without load by 7 cm.
_SWING = {"thigh": 0.25, "calf": -0.5}
_WEIGHTS = {"track_linear_velocity": 5.0, "track_angular_velocity": 4.0}
# Of a fall, in one step: a third of what a second of following commands well earns.
_FALL = -150.0


def _ease(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlOnPolicyRunnerCfg) -> Undo:
    joint_pos = env_cfg.actions["joint_pos"]
    assert isinstance(joint_pos, mdp.JointPositionActionCfg)
    let_legs_march(
        env_cfg,
        mdp.GaitClockCommandCfg(frequency=2.0, fade_s=0.2),
        mdp.MarchActionCfg(
            entity_name="robot",
            actuator_names=(".*",),
            scale=joint_pos.scale,
            swing=tuple(
                {f"{leg}_{joint}_joint": angle for joint, angle in _SWING.items()} for leg in _LEGS
            ),
            offsets=_TROT,
        ),
    )
    ease_penalties(env_cfg)
    rewards = copy.deepcopy(env_cfg.rewards)
    for name, weight in _WEIGHTS.items():
        if (term := rewards[name]) is not None:
            term.weight = weight
    rewards["feet"] = RewardTermCfg(
        func=mdp.feet_height_by_phase,
        weight=0.5,
        params={
            "height_sensor_name": "foot_height_scan",
            "offsets": _TROT,
            "rest_height": 0.0225,
            "swing_height": 0.07,
            "variance": 0.008,
        },
    )
    # Without it, a policy that is paid so much for speed trips at every other change of command.
    rewards["fall"] = RewardTermCfg(func=envs_mdp.is_terminated, weight=_FALL)
    undo = replace_rewards(env_cfg, rewards)
    evaluation = rl_cfg.evaluation
    evaluation.num_episodes = 100
    evaluation.trigger_return = 4800.0
    evaluation.min_interval = 20
    evaluation.solved_below = {"lin_vel_error": 0.25, "ang_vel_error": 0.35, "failure_rate": 0.05}
    return undo


cpu = cpu_profile(
    _ease,
    num_envs=NUM_ENVS,
    init_std=0.9,
    physics_steps=2,
    simple_contacts=True,
    unpushed_samples=400_000,
    mirror="mjlab.tasks.velocity.symmetry:mirror_left_right",
)
"""Profile of `Mjlab-Velocity-Flat-Unitree-Go1`."""
