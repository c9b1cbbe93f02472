"""Teacher of the reach task: joint targets that hold the hand at its goal."""

from __future__ import annotations

import pytest
import torch

from mjlab.envs import ManagerBasedRlEnv
from mjlab.envs.mdp import UniformPoseCommandCfg
from mjlab.tasks.reach.rl_cfg import cpu
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg
from mjlab.utils.lab_api.math import compute_pose_error

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
    for _ in range(150):
        obs = env.step(obs["teacher"][:, :6].clamp(-1.0, 1.0))[0]
    # Without the torques of gravity, the soft YAM sags out of the tolerance of most goals.
    assert env.command_manager.get_term("hand_pose").is_reached().float().mean() > 0.9
    env.close()


def test_effects_are_motions_of_the_hand() -> None:
    env = make_env()
    obs, _ = env.reset()
    command, robot = env.command_manager.get_term("hand_pose"), env.scene["robot"]
    action = env.action_manager.get_term("joint_pos")
    matrix = obs["teacher"][:, 6:].unflatten(1, (6, 6))
    moved = torch.empty(16, 6).uniform_(-0.01, 0.01)

    def pose_at(joint_pos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        robot.write_joint_position_to_sim(joint_pos, joint_ids=command.joint_ids)
        env.sim.forward()
        return tuple(part.clone() for part in command.pose_b)

    start = pose_at(command.goal_joint_pos)
    end = pose_at(command.goal_joint_pos + moved * action.scale)
    lengths = env.observation_manager.get_term_cfg("teacher", "hand").params["lengths"]
    expected = torch.cat(compute_pose_error(*start, *end), dim=1)
    effects = (matrix @ moved.unsqueeze(2)).squeeze(2)
    effects = effects * torch.tensor([lengths[0]] * 3 + [lengths[1]] * 3)
    torch.testing.assert_close(effects, expected, atol=0.1 * expected.abs().max().item(), rtol=0.0)
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
