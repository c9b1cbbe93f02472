"""Teacher of the reach task: joint targets that hold the hand at its goal."""

from __future__ import annotations

import pytest

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp import UniformPoseCommandCfg
from mjlab.tasks.reach.rl_cfg import cpu
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

TASK = "Mjlab-Reach-Yam"
RANGES = UniformPoseCommandCfg.Ranges(pos_x=(0.2, 0.4), pos_y=(0.0, 0.1), pos_z=(0.1, 0.4))


def make_env(ranges: UniformPoseCommandCfg.Ranges | None = None) -> ManagerBasedRlEnv:
    cfg = load_env_cfg(TASK)
    cpu.policy(cfg, load_rl_cfg(TASK))
    cfg.scene.num_envs, cfg.seed = 16, 1
    command = cfg.commands["hand_pose"]
    command.num_goals, command.ranges = 100, ranges
    if ranges is not None:
        del cfg.rewards["joints"]
    return ManagerBasedRlEnv(cfg, device="cpu")


def test_teacher_holds_the_hand_at_its_goal() -> None:
    env = make_env()
    obs, _ = env.reset()
    for _ in range(100):
        obs = env.step(obs["teacher"].clamp(-1.0, 1.0))[0]
    # Without the torques of gravity, the soft YAM sags out of the tolerance of most goals.
    assert env.command_manager.get_term("hand_pose").is_reached().float().mean() > 0.9
    env.close()


def test_policy_does_not_observe_the_teacher() -> None:
    cfg, rl_cfg = load_env_cfg(TASK), load_rl_cfg(TASK)
    learner = cpu.policy(cfg, rl_cfg)
    assert learner.algorithm.teacher in cfg.observations
    assert learner.algorithm.teacher not in {
        g for groups in learner.obs_groups.values() for g in groups
    }


def test_unknown_joint_positions_have_no_teacher() -> None:
    with pytest.raises(ValueError, match="without ranges"):
        make_env(RANGES)
