"""Learner configs of the velocity tasks of the Unitree G1: PPO, and the `cpu` profiles.

With the profiles, a humanoid learns to walk on two cores (`mjlab.tasks.velocity.rl.biped`). Feet have two
capsules instead of seven. Legs and hands still collide; otherwise feet pass through each other. Time step and
solver iterations are unchanged: with three steps instead of four, half of the falls are hidden, and with four
iterations feet slip on ground of high friction.
"""

from __future__ import annotations

import copy

from mjlab.asset_zoo.robots.unitree_g1.g1_constants import FULL_COLLISION
from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl.config import RslRlBaseRunnerCfg, RslRlOnPolicyRunnerCfg
from mjlab.tasks.velocity import mdp
from mjlab.tasks.velocity.rl.biped import Biped, cpu_with_stepping
from mjlab.tasks.velocity.rl.ppo import velocity_ppo_runner_cfg

_G1 = Biped(
    feet=("left_foot", "right_foot"),
    height=0.74,
    minimum_height=0.5,
    feet_distance=0.2,
    bounds={
        r".*_(hip_pitch|knee|ankle_pitch)_joint": 1.0,
        r".*_hip_(roll|yaw)_joint": 0.6,
        r".*_ankle_roll_joint": 0.8,
        r"waist_.*_joint": 0.25,
        r".*_shoulder_pitch_joint": 0.4,
        r".*_shoulder_(roll|yaw)_joint": 0.2,
        r".*_elbow_joint": 0.3,
        r".*_wrist_.*_joint": 0.1,
    },
    # From the G1 of UniLab (arXiv 2605.30313).
    pose={
        r".*_(hip_pitch|knee)_joint": 0.01,
        r".*_hip_roll_joint": 1.0,
        r".*_(hip_yaw|ankle_pitch|ankle_roll)_joint": 5.0,
        r"(waist|.*_shoulder|.*_elbow|.*_wrist)_.*": 50.0,
    },
    # The G1 drifts forward otherwise.
    gains=mdp.SteppingGains(lead=0.1),
)
# Colliding geoms: the long capsules of the feet, and the limbs that feet or hands may hit.
_FOOT = r"^(left|right)_foot[26]_collision$"
_LIMBS = tuple(
    rf".*_{part}_collision" for part in ("shin", "linkage_brace", "thigh", "hip", "hand", "wrist")
)


def unitree_g1_ppo_runner_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return the PPO config of all tasks."""
    return velocity_ppo_runner_cfg(experiment_name="g1_velocity", max_iterations=30_000)


def _simplify_contacts(env_cfg: ManagerBasedRlEnvCfg, rl_cfg: RslRlBaseRunnerCfg) -> None:
    fewer = copy.deepcopy(FULL_COLLISION)
    fewer.geom_names_expr = (_FOOT, *_LIMBS)
    env_cfg.scene.entities["robot"].collisions = (fewer,)


cpu = cpu_with_stepping(
    _G1,
    ease=_simplify_contacts,
    solved_below={"lin_vel_error": 0.35, "ang_vel_error": 0.45, "failure_rate": 0.2},
    # None of three seeds was within these bounds before iteration 103, and evaluations that fail would take
    # more than a tenth of the time.
    first_iteration=100,
)
"""The `cpu` profile of all tasks: training stops once four of five episodes last 20 s, with the task's
pushes, and the robot follows its commands."""

cpu_long = cpu_with_stepping(
    _G1,
    ease=_simplify_contacts,
    solved_below={"lin_vel_error": 0.3, "ang_vel_error": 0.3, "failure_rate": 0.05},
    num_episodes=100,
    first_iteration=110,
    min_interval=15,
)
"""The `cpu-long` profile of the flat tasks: `cpu`, until one episode of twenty falls."""
